"""The sidebar panel Render, and the engine's panels in the properties editor."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

from ..backend.environment import NOT_INSTALLED
from ..engine.engine import ENGINE
from ..jobs.follow import Reporting, submit
from ..jobs.volumes import MergeJob, PoseSnapshot
from ..places import backend_is_named
from ..scene.human import HumanTarget, humans
from ..scene.representation import representation_of
from ..scene.volume_nodes import fit_cycles_to_volumes
from .drawing import SidebarPanel, draw_job_state, property_columns
from .preferences import draw_set_up, known

_FROM_EEVEE = frozenset(
    {
        "EEVEE_MATERIAL_PT_context_material",
        "EEVEE_MATERIAL_PT_surface",
        "EEVEE_WORLD_PT_surface",
        "MATERIAL_PT_preview",
    }
)
"""Panels whose values this engine draws, too."""
_NOT_OURS = ("FREESTYLE", "freestyle", "RENDER_PT_gpencil", "RENDER_PT_grease_pencil", "PARTICLE_PT_", "stereoscopy")


class _OfEngine:
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    COMPAT_ENGINES = frozenset({ENGINE})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.engine in cls.COMPAT_ENGINES


class PRIMDIFFUSION_PT_marching(_OfEngine, bpy.types.Panel):
    """Render tab: what is drawn, how finely, and over which background."""

    bl_label = "Ray Marching"
    bl_context = "render"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = property_columns(self.layout), context.scene.primdiffusion_render
        draw_set_up(layout)
        layout.prop(settings, "view")
        layout.prop(settings, "step")
        layout.prop(context.scene.render, "film_transparent", text="Transparent")


class PRIMDIFFUSION_PT_passes(_OfEngine, bpy.types.Panel):
    """View layer tab: the passes the engine fills."""

    bl_label = "Passes"
    bl_context = "view_layer"

    def draw(self, context: bpy.types.Context) -> None:
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


def register() -> None:
    """Show Blender's own panels that suit the engine."""
    for panel in fitting_panels():
        panel.COMPAT_ENGINES.add(ENGINE)


def unregister() -> None:
    """Undo `register`."""
    for panel in bpy.types.Panel.__subclasses__():
        engines = getattr(panel, "COMPAT_ENGINES", None)
        if isinstance(engines, set):
            engines.discard(ENGINE)


_SAMPLES = 4
_ENGINES = (
    (
        ENGINE,
        "PrimDiffusion",
        "Render with PrimDiffusion: exact, a few seconds per picture; other objects get simple shading",
    ),
    ("CYCLES", "Cycles", "Render with Cycles: humans are approximate; shadows and light on other objects are correct"),
)


class PRIMDIFFUSION_OT_set_up_engine(Reporting, bpy.types.Operator):
    """Choose the render engine for humans, with the settings that they need"""

    bl_idname = "primdiffusion.set_up_engine"
    bl_label = "Switch Render Engine"
    bl_options = {"UNDO"}
    described_by = ("engine",)

    engine: bpy.props.EnumProperty(
        name="Engine", description="What renders humans", items=_ENGINES, options={"SKIP_SAVE"}
    )

    def act(self, context: bpy.types.Context) -> set[str]:
        """Camera, world, film and bounces of light between other objects stay as they are."""
        scene = context.scene
        if self.engine == ENGINE and not backend_is_named():
            raise ValueError(NOT_INSTALLED)  # views would show humans, and F12 would fail
        if self.engine == "CYCLES":
            if not hasattr(scene, "cycles"):
                raise ValueError("Cycles is disabled: enable the add-on Cycles Render Engine in the preferences")
            bounces = scene.cycles.max_bounces
            fit_cycles_to_volumes(scene, _SAMPLES)
            scene.cycles.max_bounces = bounces
        scene.render.engine = self.engine
        _plain_colours(scene)
        return _merge_all(self, context) if self.engine == "CYCLES" and known().usable else {"FINISHED"}


def _merge_all(operator: bpy.types.Operator, context: bpy.types.Context) -> set[str]:
    """Merge the humans that volumes show: Cycles then renders them in seconds. Those that move keep their volumes."""
    graph, voxel = context.evaluated_depsgraph_get(), context.scene.primdiffusion_merging.voxel
    jobs = [
        MergeJob(HumanTarget.of(person), [PoseSnapshot.capture(person, person.evaluated_get(graph))], voxel)
        for person in humans(context.scene)
        if representation_of(person) == "VOLUMES" and not (person.animation_data and person.animation_data.action)
    ]
    for job in jobs:
        submit(operator, context, job)
    return {"FINISHED"}


def _plain_colours(scene: bpy.types.Scene) -> None:
    """Other transforms change the colours that humans were made with."""
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"


def draw_next_step(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """The button that leads to a picture: an engine that shows humans as they are, the render."""
    engine = scene.render.engine
    if engine not in (ENGINE, "CYCLES") and not known().usable:
        props = layout.operator("primdiffusion.set_up_engine", text="Switch to Cycles", icon="SHADING_TEXTURE")
        props.engine = "CYCLES"
    elif engine not in (ENGINE, "CYCLES"):
        layout.operator("primdiffusion.set_up_engine", text="Switch to PrimDiffusion Engine", icon="SHADING_RENDERED")
    elif scene.camera is not None:
        layout.operator("render.render", text="Render Image", icon="RENDER_STILL")


def draw_engines(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """A choice of engines for humans."""
    engine = scene.render.engine
    row = layout.row(align=True)
    for (name, label, _), icon in zip(_ENGINES, ("SHADING_RENDERED", "SHADING_TEXTURE"), strict=True):
        if name != ENGINE or known().usable:
            row.operator("primdiffusion.set_up_engine", text=label, depress=engine == name, icon=icon).engine = name


class PRIMDIFFUSION_PT_render(SidebarPanel, bpy.types.Panel):
    """Which engine."""

    bl_label = "Render"
    bl_order = 2
    bl_options = {"DEFAULT_CLOSED"}
    manual_page = "rendering"

    def draw(self, context: bpy.types.Context) -> None:
        draw_engines(self.layout, context.scene)
        if context.scene.render.engine == ENGINE:
            draw_set_up(self.layout)
        draw_job_state(self.layout, "merge")
