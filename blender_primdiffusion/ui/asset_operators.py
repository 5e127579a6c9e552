"""Operators that make assets: of the selected human, of its pose, and of the built-in poses."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..jobs.assets import HumanAssetJob, PoseAssetJob, mark_human, write_pose_library
from ..jobs.follow import Reporting, submit
from ..jobs.target import HumanTarget
from ..scene.handles import joints_from_handles
from ..scene.human import armature_of
from .declared import SKIP
from .on_person import OnPerson

_ITEMS = (
    (
        "HUMAN",
        "Human",
        "Mark the selected human as an asset with a preview, to drag from the Asset Browser into any file",
    ),
    ("POSE", "Pose", "Mark the selected human's pose as an asset, to apply to any human from the pose library"),
)


class PRIMDIFFUSION_OT_mark_as_asset(OnPerson, bpy.types.Operator):
    """Mark the selected human, or its pose, as an asset with a preview, to use from the Asset Browser in any file"""

    bl_idname = "primdiffusion.mark_as_asset"
    bl_label = "Mark as Asset"
    described_by = ("what",)

    what: bpy.props.EnumProperty(
        name="Mark",
        description="What becomes an asset",
        items=_ITEMS,
        options=SKIP,
    )
    name: bpy.props.StringProperty(name="Name", description="Of the pose", default="Pose", options=SKIP)
    picture: bpy.props.StringProperty(
        name="Picture",
        description="Image file for the preview; empty: one is drawn",
        subtype="FILE_PATH",
        options=SKIP,
    )

    def run(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        if self.what == "POSE":
            joints_from_handles(context, armature_of(person))
        of_pose = PoseAssetJob.of(person, self.name.strip() or "Pose") if self.what == "POSE" else None
        job = of_pose or HumanAssetJob(HumanTarget.of(person))
        if not self.picture:
            return submit(self, context, job)
        picture = Path(bpy.path.abspath(self.picture))
        self.report({"INFO"}, of_pose.marked(picture) if of_pose is not None else mark_human(person, picture))
        bpy.ops.ed.undo_push(message=job.undo)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_make_pose_assets(Reporting, bpy.types.Operator):
    """Write the built-in poses as assets to a folder, and add it to the asset libraries"""

    bl_idname = "primdiffusion.make_pose_assets"
    bl_label = "Make Pose Assets"

    directory: bpy.props.StringProperty(
        name="Folder", description="Empty: in the extension's own folder", subtype="DIR_PATH", options=SKIP
    )

    def act(self, context: bpy.types.Context) -> set[str]:
        folder = Path(bpy.path.abspath(self.directory)) if self.directory else None
        path, count = write_pose_library(context, folder)
        self.report({"INFO"}, f"{count} poses are in {path}, and in the Asset Browser")
        return {"FINISHED"}
