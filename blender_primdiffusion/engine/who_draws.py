"""Which engine draws a 3D view, and whether it draws the volumes of humans."""

from __future__ import annotations

import bpy

ENGINE = "PRIMDIFFUSION"
WORKBENCH = "BLENDER_WORKBENCH"
EEVEE = "BLENDER_EEVEE"


def view_engine(engine: str, shading: str) -> str:
    """The engine that draws a 3D view with this shading, in a scene with this render engine."""
    return {"RENDERED": engine, "MATERIAL": EEVEE}.get(shading, WORKBENCH)


def renders_volumes(engine: str) -> bool:
    """Whether an engine lights volumes. Engines declare that as Blender's own do: their name is in COMPAT_ENGINES of
    the panel of a volume's file (in Blender 5.0 to 5.3 Cycles, EEVEE and Hydra Storm). Workbench declares it too, but
    draws a grey fog."""
    panel = getattr(bpy.types, "DATA_PT_volume_file", None)
    return engine in getattr(panel, "COMPAT_ENGINES", ()) and engine not in (WORKBENCH, ENGINE)
