"""The sidebar panel Render, and the engine's panels in the properties editor."""

from __future__ import annotations

import math
from collections.abc import Iterator

import bpy
from bpy.app.translations import pgettext_iface
from mathutils import Euler, Vector

from ..backend.requests import sentence
from ..engine.engine import ENGINE
from ..engine.who_draws import Drawer, renders_volumes, who_draws
from ..formats.requests import DENSITY_GAIN, VOXEL
from ..jobs import cycles_check
from ..jobs.follow import Reporting
from ..jobs.target import selected_person
from ..places import backend_is_named
from ..scene.attachment import MODES, attachment_of, in_viewport
from ..scene.human import human_of, humans
from ..scene.material import density_gain, set_density_gain
from .drawing import OUTPUT, SidebarPanel, draw_job, draw_lines, property_columns
from .render_operators import ATTACHMENT_ITEMS

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
    """Render tab: what is drawn, and how finely."""

    bl_label = "Marching"
    bl_context = "render"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = property_columns(self.layout), context.scene.primdiffusion_render
        layout.prop(settings, "view")
        layout.prop(settings, "step")
        layout.prop(settings, "solids")


class PRIMDIFFUSION_PT_film(_OfEngine, bpy.types.Panel):
    """Render tab: the background."""

    bl_label = "Film"
    bl_context = "render"

    def draw(self, context: bpy.types.Context) -> None:
        layout = property_columns(self.layout)
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


class PRIMDIFFUSION_PG_merging(bpy.types.PropertyGroup):
    """`scene.primdiffusion_merging`."""

    voxel: bpy.props.FloatProperty(
        name="Voxel Size",
        description="Voxel size of the merged volume: half the size shows more detail and takes eight times the memory",
        subtype="DISTANCE",
        unit="LENGTH",
        default=VOXEL,
        min=0.001,
        max=0.1,
        soft_min=0.003,
        soft_max=0.02,
        step=0.1,
        precision=4,
    )


def _gain(person: bpy.types.Collection) -> float:
    gain = density_gain(person)
    return DENSITY_GAIN if gain is None else gain


def _set_gain(person: bpy.types.Collection, gain: float) -> None:
    try:
        set_density_gain(person, gain)
    except ValueError as error:  # a property has no report
        print(f"PrimDiffusion: {error}")


def gain_property() -> bpy.props.FloatProperty:
    """`collection.primdiffusion_density_gain` of a human's collection."""
    return bpy.props.FloatProperty(
        name="Density Gain",
        description="Factor on the density in Cycles, which absorbs exponentially while the PrimDiffusion "
        "engine adds opacity up",
        min=0.01,
        max=100.0,
        soft_min=0.5,
        soft_max=5.0,
        step=10,
        get=_gain,
        set=_set_gain,
    )


_SAMPLES = 4
_YAW = math.radians(20)


class PRIMDIFFUSION_OT_set_up_engine(bpy.types.Operator):
    """Render with PrimDiffusion: exact, a few seconds per picture; other objects get simple shading"""

    bl_idname = "primdiffusion.set_up_engine"
    bl_label = "PrimDiffusion (Exact)"
    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        if not backend_is_named():
            cls.poll_message_set("Rendering with it needs the backend; name yours in the extension's preferences")
        return backend_is_named()

    def execute(self, context: bpy.types.Context) -> set[str]:
        context.scene.render.engine = ENGINE
        _plain_colours(context.scene)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_set_up_cycles(Reporting, bpy.types.Operator):
    """Render with Cycles: humans are approximate; shadows and light on other objects are correct"""

    bl_idname = "primdiffusion.set_up_cycles"
    bl_label = "Cycles (Approximate)"
    bl_options = {"UNDO"}

    def act(self, context: bpy.types.Context) -> set[str]:
        """Camera, world, film and bounces of light between other objects stay as they are."""
        from ..scene.cycles import fit_cycles_to_volumes  # needs numpy

        scene = context.scene
        if not hasattr(scene, "cycles"):
            raise ValueError("Cycles is disabled: enable the add-on Cycles Render Engine in the preferences")
        scene.render.engine = "CYCLES"
        bounces = scene.cycles.max_bounces
        fit_cycles_to_volumes(scene, _SAMPLES)
        scene.cycles.max_bounces = bounces
        _plain_colours(scene)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_add_camera(Reporting, bpy.types.Operator):
    """Add a camera that frames the selected human, or all humans, and a sun for other objects"""

    bl_idname = "primdiffusion.add_camera"
    bl_label = "Add Camera and Light"
    bl_options = {"UNDO"}

    def act(self, context: bpy.types.Context) -> set[str]:
        from ..scene.cycles import frame_box, humans_extent, new_camera, posed_extent  # needs numpy

        scene = context.scene
        person = human_of(context.view_layer.objects.active, scene)
        extent = humans_extent(scene) if person is None else posed_extent(person)
        camera = new_camera(scene)
        camera.name = camera.data.name = "Human Camera"
        frame_box(camera, extent, _YAW, (scene.render.resolution_x, scene.render.resolution_y))
        scene.camera = camera
        sun = bpy.data.objects.new("Human Sun", bpy.data.lights.new("Human Sun", "SUN"))
        sun.data.energy = 3.0
        sun.rotation_euler = Euler((math.radians(40), 0, math.radians(30)))
        sun.location = camera.location + Vector((0, 0, 2))
        scene.collection.objects.link(sun)
        return {"FINISHED"}


def _plain_colours(scene: bpy.types.Scene) -> None:
    """Other transforms change the colours that humans were made with."""
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"


EXACT = "Renders humans exactly, other objects with simple shading"
APPROXIMATE = "Renders humans approximately, with light and shadows"
UNLIT = "Renders humans approximately, with light and shadows; 3D views need Volumes in Viewport for that"
OTHER_ENGINE = "Renders humans blurred: choose an engine above"


def how_shown(scene: bpy.types.Scene) -> str:
    """How the scene's engine shows humans, in renders and in Rendered views."""
    engine = scene.render.engine
    drawer = who_draws(engine, "RENDERED", all(in_viewport(person) for person in humans(scene)))
    if drawer is Drawer.ENGINE:
        return EXACT
    if engine != "CYCLES":
        return OTHER_ENGINE
    return UNLIT if drawer is Drawer.OVERLAY and renders_volumes(engine) else APPROXIMATE


def draw_next_step(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """The button that leads to a picture: an engine that shows humans as they are, a camera, the render."""
    engine = scene.render.engine
    if engine not in (ENGINE, "CYCLES") and not backend_is_named():
        layout.operator("primdiffusion.set_up_cycles", text="Switch to Cycles", icon="SHADING_TEXTURE")
    elif engine not in (ENGINE, "CYCLES"):
        layout.operator("primdiffusion.set_up_engine", text="Switch to PrimDiffusion Engine", icon="SHADING_RENDERED")
    elif scene.camera is None:
        layout.operator("primdiffusion.add_camera", icon="CAMERA_DATA")
    else:
        layout.operator("render.render", text="Render Image", icon="RENDER_STILL")
    _draw_fault(layout, engine)


def draw_engines(layout: bpy.types.UILayout, scene: bpy.types.Scene) -> None:
    """A choice of engines for humans, and how the current one shows them."""
    engine, line = scene.render.engine, how_shown(scene)
    row = layout.row(align=True)
    row.operator("primdiffusion.set_up_engine", text="PrimDiffusion", depress=engine == ENGINE, icon="SHADING_RENDERED")
    row.operator("primdiffusion.set_up_cycles", text="Cycles", depress=engine == "CYCLES", icon="SHADING_TEXTURE")
    draw_lines(layout, pgettext_iface(line), "INFO")
    _draw_fault(layout, engine)


def _draw_fault(layout: bpy.types.UILayout, engine: str) -> None:
    if engine == "CYCLES" and cycles_check.volumes_are_empty():
        draw_lines(layout, sentence(cycles_check.FAULT), "ERROR")


class PRIMDIFFUSION_PT_render(SidebarPanel, bpy.types.Panel):
    """Which engine, and a camera."""

    bl_label = "Render"
    bl_category = OUTPUT
    bl_order = 0
    manual_page = "rendering"

    def draw(self, context: bpy.types.Context) -> None:
        draw_engines(self.layout, context.scene)
        self.layout.operator("primdiffusion.add_camera", icon="CAMERA_DATA")


class _OfPerson(SidebarPanel):
    bl_category = OUTPUT
    bl_options = {"DEFAULT_CLOSED"}
    bl_parent_id = "PRIMDIFFUSION_PT_render"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return bool(humans(context.scene))

    def draw(self, context: bpy.types.Context) -> None:
        property_columns(self.layout)
        try:
            person = selected_person(context)
        except ValueError as error:
            draw_lines(self.layout, sentence(error), "INFO")
            return
        self.draw_person(context, person)


class PRIMDIFFUSION_PT_attachment(_OfPerson, bpy.types.Panel):
    """How volumes follow the body."""

    bl_label = "Attachment"

    def draw_person(self, context: bpy.types.Context, person: bpy.types.Collection) -> None:
        from ..scene.merged import merged_of  # needs numpy

        now = attachment_of(person)
        row = self.layout.row(align=True)
        for mode, label, _ in ATTACHMENT_ITEMS:
            if mode != MODES[2] or merged_of(person) is not None:
                row.operator("primdiffusion.set_attachment", text=label, depress=mode == now).mode = mode
        icon = "RESTRICT_VIEW_OFF" if in_viewport(person) else "RESTRICT_VIEW_ON"
        self.layout.operator("primdiffusion.volumes_in_viewport", depress=in_viewport(person), icon=icon)


class PRIMDIFFUSION_PT_merge(_OfPerson, bpy.types.Panel):
    """One volume for Cycles."""

    bl_label = "Merge for Cycles"

    def draw_person(self, context: bpy.types.Context, person: bpy.types.Collection) -> None:
        from ..scene.merged import merged_of  # needs numpy

        layout = self.layout
        layout.prop(context.scene.primdiffusion_merging, "voxel")
        draw_job(layout, "merge", "primdiffusion.merge", "VOLUME_DATA")
        draw_job(layout, "merge_frames", "primdiffusion.merge_frames", "RENDER_ANIMATION")
        if merged_of(person) is not None:
            if outdated(person, context.scene):
                draw_lines(layout, "The merged volume is of another pose: merge again to update it", "ERROR")
            layout.operator("primdiffusion.unmerge", icon="X")


class PRIMDIFFUSION_PT_cycles_look(_OfPerson, bpy.types.Panel):
    """What brings Cycles near the exact picture."""

    bl_label = "Look in Cycles"

    def draw_person(self, context: bpy.types.Context, person: bpy.types.Collection) -> None:
        from ..scene.cycles import overlap_warning_in  # numpy, which Blender starts without

        if density_gain(person) is None:
            draw_lines(self.layout, "The human's material has no node Density Gain", "INFO")
        else:
            self.layout.prop(person, "primdiffusion_density_gain")
        draw_job(self.layout, "fit_gain", "primdiffusion.fit_density_gain", "MOD_OPACITY")
        warning = overlap_warning_in(context.scene, person)
        if warning is not None and attachment_of(person) != "MERGED":
            draw_lines(self.layout, sentence(f"{warning}, or merge the human"), "ERROR")


class PRIMDIFFUSION_PT_memory(_OfPerson, bpy.types.Panel):
    """What the human takes."""

    bl_label = "Memory"

    def draw_person(self, context: bpy.types.Context, person: bpy.types.Collection) -> None:
        from ..scene.volumes import person_memory  # needs numpy

        memory = person_memory(person)
        column = self.layout.column(align=True)
        column.label(text=f"Files: {memory.files / 1e6:.0f} MB", translate=False, icon="DISK_DRIVE")
        column.label(text=f"Volumes, once drawn: {memory.grids / 1e6:.0f} MB", translate=False, icon="MEMORY")


def outdated(person: bpy.types.Collection, scene: bpy.types.Scene) -> bool:
    """Whether the merged volume shows another pose, shape or human than the armature as it is now."""
    # needs numpy
    from ..jobs.merge import Moment
    from ..scene.merged import merged_of, merged_state

    try:
        return not merged_state(merged_of(person)).shows(Moment.now(person).digest, scene.frame_current)
    except (ValueError, OSError):  # other panels report broken bones and files
        return True


PROPERTIES = (
    (bpy.types.Scene, "primdiffusion_merging", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_merging)),
    (bpy.types.Collection, "primdiffusion_density_gain", gain_property()),
)
