"""The engine's settings in the properties editor, and the panels of Blender's own that suit it."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

from ..engine.engine import ENGINE
from .drawing import property_columns

_FROM_EEVEE = frozenset(
    {
        "EEVEE_MATERIAL_PT_context_material",
        "EEVEE_MATERIAL_PT_surface",
        "EEVEE_WORLD_PT_surface",
        "MATERIAL_PT_preview",
    }
)
"""Panels that other engines would show in vain, but whose values this one draws."""
_NOT_OURS = ("FREESTYLE", "freestyle", "RENDER_PT_gpencil", "RENDER_PT_grease_pencil", "PARTICLE_PT_", "stereoscopy")


class _OfEngine:
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    COMPAT_ENGINES = frozenset({ENGINE})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only while the engine is chosen."""
        return context.engine in cls.COMPAT_ENGINES


class PRIMDIFFUSION_PT_marching(_OfEngine, bpy.types.Panel):
    """Render tab: what is drawn, and how finely."""

    bl_label = "Marching"
    bl_context = "render"

    def draw(self, context: bpy.types.Context) -> None:
        """Settings of the scene."""
        layout, settings = property_columns(self.layout), context.scene.primdiffusion_render
        layout.prop(settings, "view")
        layout.prop(settings, "step")
        layout.prop(settings, "solids")


class PRIMDIFFUSION_PT_film(_OfEngine, bpy.types.Panel):
    """Render tab: the background."""

    bl_label = "Film"
    bl_context = "render"

    def draw(self, context: bpy.types.Context) -> None:
        """Blender's own setting."""
        layout = property_columns(self.layout)
        layout.prop(context.scene.render, "film_transparent", text="Transparent")


class PRIMDIFFUSION_PT_passes(_OfEngine, bpy.types.Panel):
    """View layer tab: the passes the engine fills."""

    bl_label = "Passes"
    bl_context = "view_layer"

    def draw(self, context: bpy.types.Context) -> None:
        """Combined is always there."""
        layout = property_columns(self.layout)
        layout.prop(context.view_layer, "use_pass_z", text="Depth")


def fitting_panels() -> Iterator[type]:
    """Blender's panels that make sense with this engine."""
    for panel in bpy.types.Panel.__subclasses__():
        engines = getattr(panel, "COMPAT_ENGINES", None)
        if isinstance(engines, set) and (panel.__name__ in _FROM_EEVEE or _suits_any_engine(panel)):
            yield panel


def _suits_any_engine(panel: type) -> bool:
    return "BLENDER_RENDER" in panel.COMPAT_ENGINES and not any(word in panel.__name__ for word in _NOT_OURS)


def join_panels() -> None:
    """Let Blender's panels be shown for the engine."""
    for panel in fitting_panels():
        panel.COMPAT_ENGINES.add(ENGINE)


def leave_panels() -> None:
    """Undo `join_panels`."""
    for panel in bpy.types.Panel.__subclasses__():
        engines = getattr(panel, "COMPAT_ENGINES", None)
        if isinstance(engines, set):
            engines.discard(ENGINE)


CLASSES = (
    PRIMDIFFUSION_PT_marching,
    PRIMDIFFUSION_PT_film,
    PRIMDIFFUSION_PT_passes,
)


def register() -> None:
    """Show Blender's own panels that suit the engine."""
    join_panels()


def unregister() -> None:
    """Undo `register`."""
    leave_panels()
