"""The sidebar panel Render: which engine draws people, how volumes follow the body, what Cycles needs."""

from __future__ import annotations

import math

import bpy
from mathutils import Euler, Vector

from ..engine.engine import ENGINE
from ..formats.requests import DENSITY_GAIN, VOXEL
from ..jobs.target import selected_person
from ..scene.attachment import MODES, attachment_of
from ..scene.human import human_of, humans
from ..scene.material import density_gain, set_density_gain
from ..worker.sentence import sentence
from .drawing import SidebarPanel, draw_job, draw_lines, property_columns
from .manual import draw_manual_button
from .render_operators import ATTACHMENT_ITEMS


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
    """`collection.primdiffusion_density_gain` of a person's collection."""
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
    bl_options = {"UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """The engine, and the view transform in which its colours are those of the people."""
        context.scene.render.engine = ENGINE
        _plain_colours(context.scene)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_set_up_cycles(bpy.types.Operator):
    """Render with Cycles: people are approximate; shadows and light on other objects are correct"""

    bl_idname = "primdiffusion.set_up_cycles"
    bl_label = "Cycles (Approximate)"
    bl_options = {"UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Settings fit for a thousand volumes; camera, world, film and bounces of light between objects stay."""
        from ..scene.preview import fit_cycles_to_volumes

        scene = context.scene
        if not hasattr(scene, "cycles"):
            self.report({"ERROR"}, "Cycles is disabled: enable the add-on Cycles Render Engine in the preferences")
            return {"CANCELLED"}
        scene.render.engine = "CYCLES"
        bounces = scene.cycles.max_bounces
        fit_cycles_to_volumes(scene, _SAMPLES)
        scene.cycles.max_bounces = bounces
        _plain_colours(scene)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_add_camera(bpy.types.Operator):
    """Add a camera that frames the selected person, or all people, and a sun for other objects"""

    bl_idname = "primdiffusion.add_camera"
    bl_label = "Add Camera and Light"
    bl_options = {"UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """The camera becomes the scene's."""
        from ..scene.preview import frame_box, humans_extent, new_camera, posed_extent

        scene = context.scene
        person = human_of(context.view_layer.objects.active, scene)
        try:
            extent = humans_extent(scene) if person is None else posed_extent(person)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
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
    """Other transforms change the colours that people were made with."""
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"


class PRIMDIFFUSION_PT_render(SidebarPanel, bpy.types.Panel):
    """Which engine, and a camera."""

    bl_label = "Render"
    bl_order = 4
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        """The manual's page."""
        draw_manual_button(self.layout, "rendering")

    def draw(self, context: bpy.types.Context) -> None:
        """Buttons of the engines."""
        engine = context.scene.render.engine
        column = self.layout.column(align=True)
        column.operator("primdiffusion.set_up_engine", depress=engine == ENGINE, icon="SHADING_RENDERED")
        column.operator("primdiffusion.set_up_cycles", depress=engine == "CYCLES", icon="SHADING_TEXTURE")
        self.layout.operator("primdiffusion.add_camera", icon="CAMERA_DATA")


class _OfPerson(SidebarPanel):
    bl_parent_id = "PRIMDIFFUSION_PT_render"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only if the scene has a human."""
        return bool(humans(context.scene))

    def draw(self, context: bpy.types.Context) -> None:
        """Of the selected person, or why there is none."""
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
        """A button for each mode; merged where there is something merged."""
        from ..scene.merged import merged_of

        now = attachment_of(person)
        row = self.layout.row(align=True)
        for mode, label, _ in ATTACHMENT_ITEMS:
            if mode != MODES[2] or merged_of(person) is not None:
                row.operator("primdiffusion.set_attachment", text=label, depress=mode == now).mode = mode


class PRIMDIFFUSION_PT_merge(_OfPerson, bpy.types.Panel):
    """One volume for Cycles."""

    bl_label = "Merge for Cycles"

    def draw_person(self, context: bpy.types.Context, person: bpy.types.Collection) -> None:
        """Voxel size, a pose, frames; whether what is merged is still the person."""
        from ..scene.merged import merged_of

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
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw_person(self, context: bpy.types.Context, person: bpy.types.Collection) -> None:
        """The gain, and a warning where volumes are dropped."""
        from ..scene.overlap import overlap_warning  # numpy, which Blender starts without

        if density_gain(person) is None:
            draw_lines(self.layout, "The person's material has no node Density Gain", "INFO")
        else:
            self.layout.prop(person, "primdiffusion_density_gain")
        draw_job(self.layout, "fit_gain", "primdiffusion.fit_density_gain", "MOD_OPACITY")
        warning = overlap_warning(person)
        if warning is not None and attachment_of(person) != "MERGED":
            draw_lines(self.layout, sentence(f"{warning}, or merge the person"), "ERROR")


class PRIMDIFFUSION_PT_memory(_OfPerson, bpy.types.Panel):
    """What the person takes."""

    bl_label = "Memory"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw_person(self, context: bpy.types.Context, person: bpy.types.Collection) -> None:
        """On disk, and in memory where drawn as volumes; the engine needs none of it."""
        from ..scene.grid_cache import person_memory

        memory = person_memory(person)
        column = self.layout.column(align=True)
        column.label(text=f"Files: {memory.files / 1e6:.0f} MB", translate=False, icon="DISK_DRIVE")
        column.label(text=f"Volumes, once drawn: {memory.grids / 1e6:.0f} MB", translate=False, icon="MEMORY")


def outdated(person: bpy.types.Collection, scene: bpy.types.Scene) -> bool:
    """Whether the merged volume shows another pose, shape or person than the armature as it is now."""
    from ..jobs.merge import Moment
    from ..scene.merged import merged_of, merged_state

    try:
        return not merged_state(merged_of(person)).shows(Moment.now(person).digest, scene.frame_current)
    except (ValueError, OSError):  # broken bones or files are other panels' to tell
        return True


CLASSES = (
    PRIMDIFFUSION_PG_merging,
    PRIMDIFFUSION_OT_set_up_engine,
    PRIMDIFFUSION_OT_set_up_cycles,
    PRIMDIFFUSION_OT_add_camera,
    PRIMDIFFUSION_PT_render,
    PRIMDIFFUSION_PT_attachment,
    PRIMDIFFUSION_PT_merge,
    PRIMDIFFUSION_PT_cycles_look,
    PRIMDIFFUSION_PT_memory,
)
PROPERTIES = (
    (bpy.types.Scene, "primdiffusion_merging", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_merging)),
    (bpy.types.Collection, "primdiffusion_density_gain", gain_property()),
)
