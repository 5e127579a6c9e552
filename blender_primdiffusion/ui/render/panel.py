"""The sidebar panel Render: with what people are drawn, how volumes follow, what Cycles needs."""

from __future__ import annotations

import bpy

from ...engine.engine import ENGINE
from ...scene.attachment import MODES, attachment_of
from ...scene.human import humans
from ...scene.material import density_gain
from ...worker.sentence import sentence
from ..jobs.drawing import draw_job, draw_lines
from ..jobs.target import selected_person
from ..manual import draw_manual_button
from .person_operators import ATTACHMENT_ITEMS


class _InSidebar:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "PrimDiffusion"


class PRIMDIFFUSION_PT_render(_InSidebar, bpy.types.Panel):
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


class _OfPerson(_InSidebar):
    bl_parent_id = "PRIMDIFFUSION_PT_render"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only where somebody is."""
        return bool(humans(context.scene))

    def draw(self, context: bpy.types.Context) -> None:
        """Of the selected person, or why there is none."""
        self.layout.use_property_split = True
        self.layout.use_property_decorate = False
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
        from ...scene.merged import merged_of

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
        from ...scene.merged import merged_of

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
        from ...scene.overlap import overlap_warning  # numpy, which Blender starts without

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
        from ...scene.grid_cache import person_memory

        memory = person_memory(person)
        column = self.layout.column(align=True)
        column.label(text=f"Files: {memory.files / 1e6:.0f} MB", translate=False, icon="DISK_DRIVE")
        column.label(text=f"Volumes, once drawn: {memory.grids / 1e6:.0f} MB", translate=False, icon="MEMORY")


def outdated(person: bpy.types.Collection, scene: bpy.types.Scene) -> bool:
    """Whether the merged volume shows another pose, shape or person than the armature as it is now."""
    from ...scene.merged import merged_of, merged_state
    from .merge_work import Moment

    try:
        return not merged_state(merged_of(person)).shows(Moment.now(person).digest, scene.frame_current)
    except (ValueError, OSError):  # broken bones or files are other panels' to tell
        return True


PANELS = (
    PRIMDIFFUSION_PT_render,
    PRIMDIFFUSION_PT_attachment,
    PRIMDIFFUSION_PT_merge,
    PRIMDIFFUSION_PT_cycles_look,
    PRIMDIFFUSION_PT_memory,
)
