"""The pose library: Blender finds our poses, applies them to any human and flips them."""

from pathlib import Path

import bpy
import numpy as np
import synthetic
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.rotation import from_axis_angle, to_axis_angle
from blender_primdiffusion.formats.poses.skeleton import REST_JOINTS, joint_positions
from pose_assets import pose_asset, pose_from_library
from support.errors import refused

import blender_primdiffusion
from blender_primdiffusion.motion.poses import current_pose, rest_joints
from blender_primdiffusion.scene.armature import build_armature, pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.convention import points_to_blender
from scripts.bake_poses.poses import LIBRARY

SAMPLE = Path(blender_primdiffusion.__file__).parent / "gallery" / "Sample.human"


def ours() -> list[str]:
    libraries = bpy.context.preferences.filepaths.asset_libraries
    return [library.path for library in libraries if library.name == "PrimDiffusion"]


def degrees(one: np.ndarray, other: np.ndarray) -> float:
    """The largest turn between rotations [24, 3, 3]."""
    return float(np.degrees(np.linalg.norm(to_axis_angle(np.swapaxes(one, -1, -2) @ other), axis=-1).max()))


def test_the_poses_are_an_asset_library_as_long_as_the_extension_is_enabled(addon):
    (folder,) = ours()
    assert (Path(folder) / "poses.blend").is_file()
    blender_primdiffusion.unregister()
    assert not ours()
    addon.preferences.filepaths.asset_libraries.new(name="PrimDiffusion", directory="/an earlier/installation")
    blender_primdiffusion.register()
    assert ours() == [folder]


def test_each_pose_is_an_asset_with_a_picture(addon):
    file = Path(ours()[0]) / "poses.blend"
    assert file.stat().st_size < 400_000
    with bpy.data.libraries.load(str(file), assets_only=True) as (there, wanted):
        assert sorted(there.actions) == sorted(LIBRARY)
        wanted.actions = list(there.actions)
    for action in wanted.actions:
        assert action.preview.image_size[:] == (160, 160)
        assert tuple(action.frame_range) == (1, 1)
    assert [len(data) for data in (bpy.data.objects, bpy.data.armatures)] == [0, 0]


def test_each_asset_is_the_pose_by_its_angles(addon):
    average = build_armature("Average", points_to_blender(REST_JOINTS))
    addon.scene.collection.objects.link(average)
    for name, pose in LIBRARY.items():
        pose_from_library(average, name)
        assert degrees(current_pose(average)[0], pose.rotations()) < 0.1, name


def test_a_generated_human_takes_each_pose_and_stands_within_six_centimetres_of_the_floor(addon):
    person = build_human(addon, SAMPLE, "Ann")
    rest = rest_joints(person)
    for name in ("T", "Sitting", "Kneeling", "Waving", "Dancing"):
        pose_from_library(person, name)
        rotations, translation = current_pose(person)
        assert degrees(rotations, LIBRARY[name].rotations()) < 1.5, name
        assert abs(joint_positions(rotations, translation, rest)[:, 1].min() - rest[:, 1].min()) < 0.06, name


def test_blender_flips_our_poses(addon):
    person = build_human(addon, SAMPLE, "Ann")
    pose_from_library(person, "Waving")
    addon.view_layer.objects.active = person
    bpy.ops.object.mode_set(mode="POSE")
    bpy.ops.pose.select_all(action="SELECT")
    bpy.ops.pose.copy()
    bpy.ops.pose.paste(flipped=True)
    swap = [JOINT_NAMES.index(bpy.utils.flip_name(name)) for name in JOINT_NAMES]
    flipped = from_axis_angle(to_axis_angle(LIBRARY["Waving"].rotations())[swap] * [1, -1, -1])
    assert degrees(current_pose(person)[0], flipped) < 1


def test_an_asset_keeps_its_data_when_a_pose_is_applied(addon):
    armature = build_human(addon, synthetic.write(Path(bpy.app.tempdir) / "p", 8), "Ann")
    action = pose_asset("A")
    armature.pose.apply_pose_from_action(action)
    assert armature.animation_data is None
    assert action.asset_data is not None


def test_reading_a_pose_names_a_missing_joint(addon):
    armature = build_armature("Other", points_to_blender(REST_JOINTS))
    pose_from_joint_rotations(armature, np.tile(np.eye(3), (24, 1, 1)))
    armature.data.bones["neck"].name = "Hals"
    with refused(ValueError, "neck"):
        current_pose(armature)
