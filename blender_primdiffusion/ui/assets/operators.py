"""People and poses as assets, and back."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...scene.human import humans
from ..jobs.follow import submit
from ..jobs.target import Target, named_person, selected_person

_HUMAN = "Name of the person (of their collection); empty: the selected one"
_PICTURE = "A picture file for it; empty: one is drawn"
_SKIP = {"SKIP_SAVE"}


class _OfPerson:
    """What these have in common."""

    bl_options: set[str] = set()  # noqa: RUF012  neither REGISTER (redo) nor UNDO (the result has one)

    human: bpy.props.StringProperty(name="Person", description=_HUMAN, options=_SKIP)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There is somebody in the scene."""
        cls.poll_message_set("Nobody is in the scene: generate a person first")
        return bool(humans(context.scene))

    def execute(self, context: bpy.types.Context) -> set[str]:
        """The picture is drawn by the backend, in line; in background mode this waits for it."""
        try:
            person = named_person(context, self.human) if self.human else selected_person(context)
            return self.act(context, person)
        except (ValueError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}


class PRIMDIFFUSION_OT_mark_human_as_asset(_OfPerson, bpy.types.Operator):
    """Make the selected person an asset with a picture, to be dragged from the Asset Browser into any file"""

    bl_idname = "primdiffusion.mark_human_as_asset"
    bl_label = "Mark Human as Asset"

    picture: bpy.props.StringProperty(name="Picture", description=_PICTURE, subtype="FILE_PATH", options=_SKIP)

    def act(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        """At once with a picture of the caller's."""
        from .work import HumanAssetWork, mark_human

        target = Target.of(person)
        if not self.picture:
            return submit(self, context, HumanAssetWork(target))
        self.report({"INFO"}, mark_human(person, Path(bpy.path.abspath(self.picture))))
        bpy.ops.ed.undo_push(message=HumanAssetWork.undo)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_mark_pose_as_asset(_OfPerson, bpy.types.Operator):
    """Make the pose the selected person is in an asset, to be applied to anybody from the pose library"""

    bl_idname = "primdiffusion.mark_pose_as_asset"
    bl_label = "Mark Pose as Asset"

    name: bpy.props.StringProperty(name="Name", description="Of the pose", default="Pose", options=_SKIP)
    picture: bpy.props.StringProperty(name="Picture", description=_PICTURE, subtype="FILE_PATH", options=_SKIP)

    def act(self, context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        """At once with a picture of the caller's."""
        from .work import PoseAssetWork

        work = PoseAssetWork.of(person, self.name.strip() or "Pose")
        if not self.picture:
            return submit(self, context, work)
        self.report({"INFO"}, work.marked(Path(bpy.path.abspath(self.picture))))
        bpy.ops.ed.undo_push(message=PoseAssetWork.undo)
        return {"FINISHED"}


class PRIMDIFFUSION_OT_unmark_human_asset(_OfPerson, bpy.types.Operator):
    """Make the selected person an ordinary collection again; nothing of them is removed"""

    bl_idname = "primdiffusion.unmark_human_asset"
    bl_label = "Unmark Human Asset"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def act(self, _context: bpy.types.Context, person: bpy.types.Collection) -> set[str]:
        """At once."""
        if person.library is not None:
            raise ValueError(f"{person.name!r} is linked from {person.library.filepath!r}: unmark it there")
        if person.asset_data is None:
            raise ValueError(f"{person.name!r} is no asset: there is nothing to unmark")
        person.asset_clear()
        return {"FINISHED"}


class PRIMDIFFUSION_OT_make_pose_assets(bpy.types.Operator):
    """Write the built-in poses as assets into a folder of your own, and add it to the asset libraries"""

    bl_idname = "primdiffusion.make_pose_assets"
    bl_label = "Make Pose Assets"
    bl_options: set[str] = set()  # noqa: RUF012  the open file stays as it is

    directory: bpy.props.StringProperty(
        name="Folder", description="Empty: in the extension's own folder", subtype="DIR_PATH", options=_SKIP
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """A .blend with an action for each pose; one written before is replaced."""
        from .library import write_pose_library

        folder = Path(bpy.path.abspath(self.directory)) if self.directory else None
        try:
            path, count = write_pose_library(context, folder)
        except (ValueError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{count} poses are in {path}, and in the Asset Browser")
        return {"FINISHED"}
