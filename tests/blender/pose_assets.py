"""Poses of the extension's asset library, given to armatures as Blender's pose library does."""

from pathlib import Path

import bpy


def pose_asset(name: str) -> bpy.types.Action:
    """A pose of the library in the preferences, appended to this file."""
    library = bpy.context.preferences.filepaths.asset_libraries["PrimDiffusion"]
    with bpy.data.libraries.load(str(Path(library.path) / "poses.blend"), assets_only=True) as (_, wanted):
        wanted.actions = [name]
    return wanted.actions[0]


def pose_from_library(armature: bpy.types.Object, name: str) -> None:
    """Pose all bones."""
    action = pose_asset(name)
    armature.pose.apply_pose_from_action(action)
    bpy.data.actions.remove(action)
