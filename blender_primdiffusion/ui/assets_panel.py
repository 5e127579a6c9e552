"""The sub-panel Assets: the selected person, their pose and the built-in poses in the Asset Browser."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..jobs.follow import submit
from ..jobs.target import Target, selected_person
from ..scene.human import humans
from ..worker.sentence import sentence
from .drawing import SidebarPanel, draw_job, draw_lines, property_columns
from .manual import draw_manual_button
from .on_person import SKIP, OnPerson
from .translations import CONTEXT

_PICTURE = "Picture file for the asset; empty: one is drawn"


class PRIMDIFFUSION_OT_mark_human_as_asset(OnPerson, bpy.types.Operator):
    """Make the selected person an asset with a picture, to be dragged from the Asset Browser into any file"""

    bl_idname = "primdiffusion.mark_human_as_asset"
    bl_label = "Mark Human as Asset"
    bl_options: set[str] = set()  # noqa: RUF012  the result makes the undo step

    picture: bpy.props.StringProperty(name="Picture", description=_PICTURE, subtype="FILE_PATH", options=SKIP)

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        """At once with a picture of the caller's."""
        from ..jobs.assets import HumanAssetJob, mark_human

        target = Target.of(person)
        if not self.picture:
            return submit(self, context, HumanAssetJob(target))
        self.report({"INFO"}, mark_human(person, Path(bpy.path.abspath(self.picture))))
        bpy.ops.ed.undo_push(message=HumanAssetJob.undo)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_mark_pose_as_asset(OnPerson, bpy.types.Operator):
    """Make the selected person's pose an asset that can be applied to any person from the pose library"""

    bl_idname = "primdiffusion.mark_pose_as_asset"
    bl_label = "Mark Pose as Asset"
    bl_options: set[str] = set()  # noqa: RUF012  the result makes the undo step

    name: bpy.props.StringProperty(name="Name", description="Of the pose", default="Pose", options=SKIP)
    picture: bpy.props.StringProperty(name="Picture", description=_PICTURE, subtype="FILE_PATH", options=SKIP)

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        """At once with a picture of the caller's."""
        from ..jobs.assets import PoseAssetJob

        job = PoseAssetJob.of(person, self.name.strip() or "Pose")
        if not self.picture:
            return submit(self, context, job)
        self.report({"INFO"}, job.marked(Path(bpy.path.abspath(self.picture))))
        bpy.ops.ed.undo_push(message=PoseAssetJob.undo)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_unmark_human_asset(OnPerson, bpy.types.Operator):
    """Make the selected person an ordinary collection again; nothing of them is removed"""

    bl_idname = "primdiffusion.unmark_human_asset"
    bl_label = "Unmark Human Asset"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def run(self, _context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        """At once."""
        if person.library is not None:
            raise ValueError(f"{person.name!r} is linked from {person.library.filepath!r}: unmark it there")
        if person.asset_data is None:
            raise ValueError(f"{person.name!r} is not an asset: there is nothing to unmark")
        person.asset_clear()
        return {"FINISHED"}


class PRIMDIFFUSION_OT_make_pose_assets(bpy.types.Operator):
    """Write the built-in poses as assets into a folder of your own, and add it to the asset libraries"""

    bl_idname = "primdiffusion.make_pose_assets"
    bl_label = "Make Pose Assets"
    bl_options: set[str] = set()  # noqa: RUF012  the open file stays as it is

    directory: bpy.props.StringProperty(
        name="Folder", description="Empty: in the extension's own folder", subtype="DIR_PATH", options=SKIP
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """A .blend with an action for each pose; one written before is replaced."""
        from ..jobs.assets import write_pose_library

        folder = Path(bpy.path.abspath(self.directory)) if self.directory else None
        try:
            path, count = write_pose_library(context, folder)
        except (ValueError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{count} poses are in {path}, and in the Asset Browser")
        return {"FINISHED"}


class PRIMDIFFUSION_PT_assets(SidebarPanel, bpy.types.Panel):
    """People and poses for other files."""

    bl_label = "Assets"
    bl_translation_context = CONTEXT
    bl_parent_id = "PRIMDIFFUSION_PT_human"
    bl_order = 90
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw_header_preset(self, _context: bpy.types.Context) -> None:
        """The manual's page."""
        draw_manual_button(self.layout, "assets")

    def draw(self, context: bpy.types.Context) -> None:
        """Reads the scene; changes nothing."""
        layout = property_columns(self.layout)
        try:
            person = selected_person(context) if humans(context.scene) else None
        except ValueError as error:
            draw_lines(layout, sentence(error), "INFO")
            return
        if person is not None and person.asset_data is not None:
            layout.operator("primdiffusion.unmark_human_asset", icon="X")
        else:
            draw_job(layout, "human_asset", "primdiffusion.mark_human_as_asset", "ASSET_MANAGER")
        draw_job(layout, "pose_asset", "primdiffusion.mark_pose_as_asset", "ARMATURE_DATA")
        layout.operator("primdiffusion.make_pose_assets", icon="FILE_FOLDER")


CLASSES = (
    PRIMDIFFUSION_OT_mark_human_as_asset,
    PRIMDIFFUSION_OT_mark_pose_as_asset,
    PRIMDIFFUSION_OT_unmark_human_asset,
    PRIMDIFFUSION_OT_make_pose_assets,
    PRIMDIFFUSION_PT_assets,
)
