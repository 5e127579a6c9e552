"""Who draws humans in a 3D view. Views and panels ask here."""

from __future__ import annotations

import enum

import bpy

ENGINE = "PRIMDIFFUSION"
WORKBENCH = "BLENDER_WORKBENCH"
EEVEE = "BLENDER_EEVEE"


class Drawer(enum.Enum):
    """Who draws a human in a 3D view."""

    ENGINE = "the PrimDiffusion engine, into its own picture"
    VOLUMES = "another render engine, as volumes with light and shadows"
    OVERLAY = "this extension, over what Blender draws"


def who_draws(engine: str, shading: str, volumes_shown: bool) -> Drawer:
    """Who draws a human in a 3D view with this `shading.type`, while the scene has this render engine.

    `volumes_shown`: the view contains the human's volumes, which new humans hide in viewports.
    """
    drawing = view_engine(engine, shading)
    if drawing == ENGINE:
        return Drawer.ENGINE
    return Drawer.VOLUMES if volumes_shown and renders_volumes(drawing) else Drawer.OVERLAY


def view_engine(engine: str, shading: str) -> str:
    """The engine that draws a 3D view with this shading, in a scene with this render engine."""
    return {"RENDERED": engine, "MATERIAL": EEVEE}.get(shading, WORKBENCH)


def renders_volumes(engine: str) -> bool:
    """Whether an engine lights volumes. Engines declare that as Blender's own do: their name is in COMPAT_ENGINES of
    the panel of a volume's file (in Blender 5.0 to 5.3 Cycles, EEVEE and Hydra Storm). Workbench declares it too, but
    draws a grey fog."""
    panel = getattr(bpy.types, "DATA_PT_volume_file", None)
    return engine in getattr(panel, "COMPAT_ENGINES", ()) and engine not in (WORKBENCH, ENGINE)
