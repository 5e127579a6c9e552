"""The pose library: poses, their pictures, applying, mirroring, saving and deleting."""

from __future__ import annotations

from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np
import pytest
import synthetic
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.rotation import from_axis_angle, to_axis_angle
from blender_primdiffusion.formats.poses.skeleton import joint_positions
from blender_primdiffusion.formats.regular_files import FileError
from support.errors import refused

from blender_primdiffusion.motion.pose_library import (
    apply_pose,
    builtin_poses,
    current_pose,
    delete_pose,
    load_pose,
    mirrored,
    own_poses,
    rest_joints,
    save_pose,
)
from blender_primdiffusion.scene.actions import action_curves
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.ui import pose_panel
from blender_primdiffusion.ui.pose_panel import PRIMDIFFUSION_PT_poses

ops = bpy.ops.primdiffusion
REST = np.tile(np.eye(3), (24, 1, 1))


@pytest.fixture
def armature(addon, tmp_path, monkeypatch):
    monkeypatch.setattr(pose_panel, "own_folder", lambda: tmp_path / "eigene Dateien")
    return build_human(addon, synthetic.write(tmp_path / "p", 8), "Ann")


def test_every_built_in_pose_is_finite_and_has_a_picture(addon):
    poses = builtin_poses()
    assert len(poses) >= 16
    for name, pose in poses.items():
        assert pose.shape == (24, 3)
        assert np.isfinite(pose).all()
        assert (pose_panel._PICTURES / f"{name}.png").is_file()
    pictures = list(pose_panel._PICTURES.iterdir())
    assert {path.stem for path in pictures} == set(poses)
    assert sum(path.stat().st_size for path in pictures) < 300_000
    np.testing.assert_array_equal(poses["T"], np.zeros((24, 3)))


def test_mirroring_twice_is_nothing_and_once_is_the_mirrored_skeleton():
    pose = np.random.default_rng(0).normal(0, 0.5, (24, 3))
    np.testing.assert_array_equal(mirrored(mirrored(pose)), pose)
    rest = synthetic.joints()
    swap = [
        JOINT_NAMES.index(n.replace("left", "#").replace("right", "left").replace("#", "right")) for n in JOINT_NAMES
    ]
    here, there = (joint_positions(from_axis_angle(p), rest=rest) for p in (pose, mirrored(pose)))
    np.testing.assert_allclose(there, here[swap] * [-1, 1, 1], atol=1e-9)


@pytest.mark.parametrize("name", ["T", "Sitting", "Kneeling", "Waving", "Dancing"])
def test_an_applied_pose_is_the_pose_and_stands_on_the_floor(armature, name):
    assert ops.apply_pose(pose_name=name) == {"FINISHED"}
    rotations, translation = current_pose(armature)
    np.testing.assert_allclose(rotations, from_axis_angle(builtin_poses()[name]), atol=1e-5)
    rest = rest_joints(armature)
    low = joint_positions(rotations, translation, rest)[:, 1].min() - rest[:, 1].min()
    assert abs(low) < 0.08


def test_half_of_a_pose_is_half_of_each_turn(armature):
    ops.apply_pose(pose_name="A", amount=0.5)
    np.testing.assert_allclose(to_axis_angle(current_pose(armature)[0]), builtin_poses()["A"] / 2, atol=1e-5)


def test_only_selected_bones_turn(addon, armature):
    addon.view_layer.objects.active = armature
    with refused(RuntimeError, "Ann"):
        ops.apply_pose(pose_name="A", only_selected=True)
    bone = armature.pose.bones["left_shoulder"]
    (bone if bpy.app.version >= (5, 0, 0) else bone.bone).select = True
    ops.apply_pose(pose_name="A", only_selected=True)
    turned = np.abs(current_pose(armature)[0] - np.eye(3)).max((-1, -2)) > 1e-3
    assert [JOINT_NAMES[j] for j in np.flatnonzero(turned)] == ["left_shoulder"]


def test_mirror_pose_and_reset(armature):
    ops.apply_pose(pose_name="Waving")
    ops.apply_pose(what="MIRRORED")
    np.testing.assert_allclose(
        current_pose(armature)[0], from_axis_angle(mirrored(builtin_poses()["Waving"])), atol=1e-5
    )
    assert ops.apply_pose(what="REST") == {"FINISHED"}
    np.testing.assert_allclose(current_pose(armature)[0], REST, atol=1e-5)
    np.testing.assert_allclose(current_pose(armature)[1], 0, atol=1e-6)


def test_a_locked_bone_stays(armature):
    armature.pose.bones["head"].lock_rotation = (True, True, True)
    changed = apply_pose(armature, builtin_poses()["Dancing"])
    assert set(JOINT_NAMES) - set(changed) == {"head"}
    np.testing.assert_allclose(current_pose(armature)[0][15], np.eye(3), atol=1e-6)


def test_auto_keying_keys_what_was_applied(addon, armature):
    addon.scene.tool_settings.use_keyframe_insert_auto = True
    try:
        ops.apply_pose(pose_name="A")
    finally:
        addon.scene.tool_settings.use_keyframe_insert_auto = False
    assert len(action_curves(armature)) == 24 * 4 + 3


def test_a_saved_pose_is_in_the_library_and_comes_back_exactly(addon, armature, tmp_path):
    ops.apply_pose(pose_name="Kneeling")
    rotations, translation = current_pose(armature)
    assert ops.save_pose(pose_name="Kniend, müde") == {"FINISHED"}
    assert addon.scene.primdiffusion_motion.pose == "Kniend, müde"
    ops.apply_pose(what="REST")
    ops.apply_pose(pose_name="Kniend, müde")
    np.testing.assert_allclose(current_pose(armature)[0], rotations, atol=1e-5)
    np.testing.assert_allclose(current_pose(armature)[1], translation, atol=1e-5)
    with refused(RuntimeError, "Kniend, müde"):
        ops.save_pose(pose_name="Kniend, müde")
    assert ops.save_pose(delete=True, pose_name="Kniend, müde") == {"FINISHED"}
    assert addon.scene.primdiffusion_motion.pose == "T"
    assert not list((tmp_path / "eigene Dateien").rglob("*.*"))
    with refused(RuntimeError, "Kniend, müde"):
        ops.apply_pose(pose_name="Kniend, müde")


@pytest.mark.parametrize("name", ["T", "", "../x", "a" * 61, "."])
def test_names_that_cannot_be_are_rejected(armature, name):
    with pytest.raises(RuntimeError, match=r"built-in pose|cannot be called"):
        ops.save_pose(pose_name=name)


def test_a_built_in_pose_cannot_be_deleted(armature):
    with refused(RuntimeError, "T"):
        ops.save_pose(delete=True, pose_name="T")
    ops.save_pose(pose_name="mine")
    with refused(RuntimeError, "T"):
        ops.save_pose(delete=True, pose_name="T")
    assert ops.save_pose(delete=True) == {"FINISHED"}, "the panel's pose"


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"pose": [[0, 0, 0]], "transl": [0, 0, 0]}', '{"pose": "x", "transl": [0, 0, 0]}']
)
def test_a_damaged_pose_file_is_named(armature, tmp_path, content):
    folder = tmp_path / "eigene Dateien" / "poses"
    folder.mkdir(parents=True)
    (folder / "bad.pose.json").write_text(content)
    with refused(RuntimeError, "bad.pose.json"):
        ops.apply_pose(pose_name="bad")
    np.testing.assert_allclose(current_pose(armature)[0], REST, atol=1e-5)


def test_a_folder_that_cannot_be_written_is_reported(tmp_path):
    (tmp_path / "file").write_text("")
    with refused(FileError):
        save_pose(tmp_path / "file", "a", np.zeros((24, 3)), np.zeros(3))
    path = save_pose(tmp_path / "poses", "a", np.ones((24, 3)), np.arange(3.0))
    np.testing.assert_array_equal(load_pose(path)[1], [0, 1, 2])
    assert list(own_poses(tmp_path / "poses")) == ["a"]


def test_poses_of_wrong_shape_are_rejected(armature):
    with refused(ValueError, "24 axis-angle vectors"):
        apply_pose(armature, np.zeros((23, 3)))


def test_edit_mode_and_a_renamed_bone_are_rejected(addon, armature):
    addon.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for operator, given in (
        (ops.apply_pose, {"what": "MIRRORED"}),
        (ops.apply_pose, {"what": "REST"}),
        (ops.key_pose, {}),
    ):
        with refused(RuntimeError, "Edit Mode"):
            operator(**given)
    with refused(RuntimeError, "Edit Mode"):
        ops.apply_pose()
    bpy.ops.object.mode_set(mode="OBJECT")
    armature.data.bones["neck"].name = "Hals"
    for operator in (ops.apply_pose, ops.save_pose):
        with refused(RuntimeError, "neck"):
            operator()


def test_the_panel_shows_pictures_and_offers_to_delete_only_own_poses(addon, armature):
    def buttons() -> list[str]:
        layout = MagicMock()
        layout.row.return_value = layout
        PRIMDIFFUSION_PT_poses.draw(SimpleNamespace(layout=layout), addon)
        return [call.kwargs.get("text") for call in layout.operator.call_args_list]

    assert "Delete Pose" not in buttons()
    ops.save_pose(pose_name="mine")
    assert "Delete Pose" in buttons()
    assert "mine" in [item[0] for item in pose_panel.pose_items(None, addon)]


def test_a_hand_keyed_pose_is_where_it_was(addon, armature):
    armature.pose.bones["head"].rotation_mode = "XYZ"
    armature.pose.bones["head"].rotation_euler = (0.3, 0.1, 0)
    wanted = current_pose(armature)[0][15]
    addon.scene.frame_set(7)
    armature.pose.bones["head"].rotation_euler = (0.3, 0.1, 0)
    assert ops.key_pose() == {"FINISHED"}
    addon.scene.frame_set(9)
    np.testing.assert_allclose(current_pose(armature)[0][15], wanted, atol=1e-6)
    assert len(action_curves(armature)) == 24 * 4 + 3
    np.testing.assert_allclose(from_axis_angle(to_axis_angle(wanted)), wanted, atol=1e-6)


@pytest.mark.any_blender
def test_links_in_place_of_poses_lose_no_file_outside(tmp_path):
    (tmp_path / "outside").mkdir()
    mine = tmp_path / "outside" / "mine"
    mine.write_text("mine")
    folder = tmp_path / "poses"
    folder.mkdir()
    for name in ("sit.pose.json", "sit.pose.png"):
        (folder / name).symlink_to(mine)
    (folder / "lie.pose.json").symlink_to(mine.with_name("nothing"))
    save_pose(folder, "lie", np.zeros((24, 3)), np.zeros(3))
    delete_pose(folder / "sit.pose.json")
    assert [path.name for path in folder.iterdir()] == ["lie.pose.json"]
    assert [path.name for path in mine.parent.iterdir()] == ["mine"]
    assert mine.read_text() == "mine"
