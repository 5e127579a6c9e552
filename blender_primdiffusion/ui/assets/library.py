"""The built-in poses as an asset library on disk."""

from __future__ import annotations

import os
from pathlib import Path

import bpy
import numpy as np

from ...motion.pose_library import builtin_poses
from ...motion.poses import grounding
from ...motion.rotation import from_axis_angle
from ...motion.skeleton import REST_JOINTS, joint_positions
from ...places import own_folder
from ...scene.armature import build_armature
from ...scene.convention import points_to_blender
from .marking import POSE_TAG, mark, pose_action
from .thumbnails import clay_figure

LIBRARY = "PrimDiffusion"
"""What the asset library is called in the preferences."""
FILE = "poses.blend"


def write_pose_library(context: bpy.types.Context, folder: Path | None = None) -> tuple[Path, int]:
    """Write FILE into `folder`, which becomes an asset library; returns its path and the number of poses.

    The open file is as before. Raises OSError where it cannot be written.
    """
    folder = folder if folder is not None else own_folder() / "assets"
    folder.mkdir(parents=True, exist_ok=True)
    path, unfinished = folder / FILE, folder / f".{FILE}"
    armature = build_armature("PrimDiffusion Poses", points_to_blender(REST_JOINTS))
    context.scene.collection.objects.link(armature)  # only what is in a scene has a pose
    actions: set[bpy.types.Action] = set()
    try:
        context.view_layer.update()
        for name, vectors in builtin_poses().items():
            actions.add(_asset(armature, name, from_axis_angle(vectors)))
        bpy.data.libraries.write(str(unfinished), actions, fake_user=True, compress=True)
        os.replace(unfinished, path)
    except RuntimeError as error:
        raise OSError(f"{path} could not be written: {error}") from error
    finally:
        unfinished.unlink(missing_ok=True)
        data = armature.data
        bpy.data.batch_remove([*actions, armature, data])
    _add_library(folder)
    return path, len(builtin_poses())


def _asset(armature: bpy.types.Object, name: str, rotations: np.ndarray) -> bpy.types.Action:
    place = grounding(rotations[None])
    title = name[:1].upper() + name[1:]
    action = pose_action(armature, rotations, place[0], title)
    figure = clay_figure(joint_positions(rotations[None], place)[0])
    mark(action, f"{title}, a built-in pose", [POSE_TAG, "built-in"], figure)
    return action


def _add_library(folder: Path) -> None:
    libraries = bpy.context.preferences.filepaths.asset_libraries
    if not any(Path(library.path) == folder for library in libraries if library.path):
        libraries.new(name=LIBRARY, directory=str(folder))
