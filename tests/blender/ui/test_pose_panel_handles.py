"""IK handles as the panel offers them, beside the pose library, keys, motions and edits of the shape."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
import synthetic
from jobs_driven import shown

from blender_primdiffusion.scene.actions import action_curves
from blender_primdiffusion.scene.armature import CONTROLS, LIMBS
from blender_primdiffusion.scene.handles import has_handles
from blender_primdiffusion.ui import pose_panel

ops = bpy.ops.primdiffusion
EXACT_M = 1e-4
OUT_OF_REACH_M = 1e-3
"""Where a hand cannot reach its handle, Blender's solver ends within this, depending on where it starts."""


def heads(armature) -> np.ndarray:
    """Joints [24, 3] as they are seen, in the armature's space."""
    bpy.context.view_layer.update()
    return np.array([armature.pose.bones[name].head for name in synthetic.NAMES])


def in_pose(armature, name) -> np.ndarray:
    ops.apply_pose(what="REST")
    ops.apply_pose(pose_name=name, ground=False)
    return heads(armature)


def test_the_panel_offers_to_add_handles_or_else_to_bake_them(addon, armature):
    drawn = set(shown(pose_panel.PRIMDIFFUSION_PT_poses, addon))
    assert "primdiffusion.add_handles" in drawn
    assert "primdiffusion.bake_handles" not in drawn
    assert ops.add_handles() == {"FINISHED"}
    drawn = set(shown(pose_panel.PRIMDIFFUSION_PT_poses, addon))
    assert "primdiffusion.bake_handles" in drawn
    assert "primdiffusion.add_handles" not in drawn
    assert ops.bake_handles() == {"FINISHED"}
    assert not has_handles(armature)
    with pytest.raises(RuntimeError, match="no IK handles"):
        ops.bake_handles()


@pytest.mark.parametrize("name", ["Sitting", "Waving", "T"])
def test_a_pose_of_the_library_looks_the_same_with_handles(armature, name):
    wanted = in_pose(armature, name)
    ops.apply_pose(pose_name="Dancing")
    ops.add_handles()
    np.testing.assert_allclose(in_pose(armature, name), wanted, atol=EXACT_M)
    for limb in LIMBS:
        handle = np.array(armature.pose.bones[limb.handle].head)
        np.testing.assert_allclose(handle, wanted[synthetic.NAMES.index(limb.end)], atol=EXACT_M)


def test_mirroring_and_resetting_move_the_handles_too(armature):
    ops.apply_pose(pose_name="Reaching", ground=False)
    ops.apply_pose(what="MIRRORED")
    mirrored = heads(armature)
    ops.apply_pose(what="REST")
    rest = heads(armature)
    ops.apply_pose(pose_name="Reaching", ground=False)
    ops.add_handles()
    ops.apply_pose(what="MIRRORED")
    np.testing.assert_allclose(heads(armature), mirrored, atol=EXACT_M)
    ops.apply_pose(what="REST")
    np.testing.assert_allclose(heads(armature), rest, atol=EXACT_M)


def test_a_saved_pose_is_the_one_that_handles_show(armature, tmp_path, monkeypatch):
    monkeypatch.setattr(pose_panel, "own_folder", lambda: tmp_path / "own")
    ops.add_handles()
    armature.pose.bones["left_hand_ik"].location = (0.1, -0.2, 0.1)
    armature.pose.bones["pelvis"].location = (0.0, -0.1, 0.0)
    seen = heads(armature)
    ops.save_pose(pose_name="mine")
    np.testing.assert_allclose(heads(armature), seen, atol=OUT_OF_REACH_M)
    ops.bake_handles()
    np.testing.assert_allclose(heads(armature), seen, atol=OUT_OF_REACH_M)
    ops.apply_pose(what="REST")
    ops.apply_pose(pose_name="mine")
    np.testing.assert_allclose(heads(armature), seen, atol=OUT_OF_REACH_M)


def test_keying_the_pose_keys_joints_and_handles_as_they_are_seen(addon, armature):
    ops.add_handles()
    addon.scene.frame_set(1)
    ops.key_pose()
    addon.scene.frame_set(11)
    armature.pose.bones["left_foot_ik"].location = (0.0, 0.15, 0.1)
    seen = heads(armature)
    ops.key_pose()
    for frame in (1, 11):
        addon.scene.frame_set(frame)
    np.testing.assert_allclose(heads(armature), seen, atol=EXACT_M)
    ops.bake_handles()
    addon.scene.frame_set(1)
    assert np.abs(heads(armature) - seen).max() > 0.1
    addon.scene.frame_set(11)
    np.testing.assert_allclose(heads(armature), seen, atol=EXACT_M)
    assert {len(curve.keyframe_points) for curve in action_curves(armature) if "left_knee" in curve.data_path} == {11}


def test_a_pose_is_keyed_with_its_handles_where_keys_are_set_automatically(addon, armature):
    ops.add_handles()
    addon.scene.tool_settings.use_keyframe_insert_auto = True
    addon.scene.frame_set(5)
    wanted = in_pose(armature, "Walking")
    addon.scene.frame_set(20)
    in_pose(armature, "Squatting")
    addon.scene.frame_set(5)
    np.testing.assert_allclose(heads(armature), wanted, atol=EXACT_M)


@pytest.mark.parametrize("call", [lambda: ops.add_motion(motion="WALK"), lambda: ops.use_action(action="")])
def test_motions_wait_until_handles_are_baked(armature, call):
    ops.add_motion(motion="WAVE", rounds=1)
    ops.add_handles()
    action = armature.animation_data.action
    with pytest.raises(RuntimeError, match="has IK handles"):
        call()
    assert armature.animation_data.action == action
    ops.bake_handles()
    assert call() == {"FINISHED"}


def test_undo_takes_handles_away_and_brings_them_back(addon, armature):
    in_pose(armature, "Walking")
    bpy.ops.ed.undo_push(message="before")
    ops.add_handles()
    bpy.ops.ed.undo_push(message="handles")
    before = heads(armature)
    ops.bake_handles()
    bpy.ops.ed.undo_push(message="baked")
    bpy.ops.ed.undo()
    again = bpy.data.objects["Ann"]
    assert all(name in again.data.bones for name in CONTROLS)
    np.testing.assert_allclose(heads(again), before, atol=EXACT_M)
    bpy.ops.ed.undo()
    assert not has_handles(bpy.data.objects["Ann"])
