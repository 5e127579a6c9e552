"""The panel Assets: the selected human, its pose and the built-in poses in the Asset Browser."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..backend.requests import sentence
from ..jobs.follow import Reporting, submit
from ..jobs.target import HumanTarget, selected_person
from ..scene.human import humans
from .drawing import OUTPUT, SidebarPanel, draw_job, draw_lines, property_columns
from .on_person import SKIP, OnPerson
from .translations import CONTEXT

_PICTURE = "Image file for the preview; empty: one is drawn"


class PRIMDIFFUSION_OT_mark_human_as_asset(OnPerson, bpy.types.Operator):
    """Mark the selected human as an asset with a preview, to drag from the Asset Browser into any file"""

    bl_idname = "primdiffusion.mark_human_as_asset"
    bl_label = "Mark Human as Asset"

    picture: bpy.props.StringProperty(name="Picture", description=_PICTURE, subtype="FILE_PATH", options=SKIP)

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        from ..jobs.assets import HumanAssetJob, mark_human  # needs numpy

        target = HumanTarget.of(person)
        if not self.picture:
            return submit(self, context, HumanAssetJob(target))
        self.report({"INFO"}, mark_human(person, Path(bpy.path.abspath(self.picture))))
        bpy.ops.ed.undo_push(message=HumanAssetJob.undo)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_mark_pose_as_asset(OnPerson, bpy.types.Operator):
    """Mark the selected human's pose as an asset, to apply to any human from the pose library"""

    bl_idname = "primdiffusion.mark_pose_as_asset"
    bl_label = "Mark Pose as Asset"

    name: bpy.props.StringProperty(name="Name", description="Of the pose", default="Pose", options=SKIP)
    picture: bpy.props.StringProperty(name="Picture", description=_PICTURE, subtype="FILE_PATH", options=SKIP)

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        from ..jobs.assets import PoseAssetJob  # needs numpy

        job = PoseAssetJob.of(person, self.name.strip() or "Pose")
        if not self.picture:
            return submit(self, context, job)
        self.report({"INFO"}, job.marked(Path(bpy.path.abspath(self.picture))))
        bpy.ops.ed.undo_push(message=PoseAssetJob.undo)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_unmark_human_asset(OnPerson, bpy.types.Operator):
    """Unmark the selected human as an asset; the human stays"""

    bl_idname = "primdiffusion.unmark_human_asset"
    bl_label = "Unmark Human Asset"
    bl_options = {"REGISTER", "UNDO"}

    def run(self, _context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        if person.library is not None:
            raise ValueError(f"{person.name!r} is linked from {person.library.filepath!r}: unmark it there")
        if person.asset_data is None:
            raise ValueError(f"{person.name!r} is not an asset: there is nothing to unmark")
        person.asset_clear()
        return {"FINISHED"}


class PRIMDIFFUSION_OT_make_pose_assets(Reporting, bpy.types.Operator):
    """Write the built-in poses as assets to a folder, and add it to the asset libraries"""

    bl_idname = "primdiffusion.make_pose_assets"
    bl_label = "Make Pose Assets"

    directory: bpy.props.StringProperty(
        name="Folder", description="Empty: in the extension's own folder", subtype="DIR_PATH", options=SKIP
    )

    def act(self, context: bpy.types.Context) -> set[str]:
        from ..jobs.assets import write_pose_library  # needs numpy

        folder = Path(bpy.path.abspath(self.directory)) if self.directory else None
        path, count = write_pose_library(context, folder)
        self.report({"INFO"}, f"{count} poses are in {path}, and in the Asset Browser")
        return {"FINISHED"}


class PRIMDIFFUSION_PT_assets(SidebarPanel, bpy.types.Panel):
    """Humans and poses for other files."""

    bl_label = "Assets"
    bl_translation_context = CONTEXT
    bl_category = OUTPUT
    bl_order = 7
    bl_options = {"DEFAULT_CLOSED"}
    manual_page = "assets"

    def draw(self, context: bpy.types.Context) -> None:
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
