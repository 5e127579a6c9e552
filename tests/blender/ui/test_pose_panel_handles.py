"""The panel Pose: the way to the pose library, and IK handles beside motions."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
import synthetic
from jobs_driven import Layout, shown
from pose_assets import pose_from_library

from blender_primdiffusion.scene.armature import CONTROLS
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


def test_the_panel_leads_to_the_asset_shelf_of_pose_mode(addon, armature):
    addon.view_layer.objects.active = armature
    for button, other in (
        ("object.posemode_toggle", "show_region_asset_shelf"),
        ("show_region_asset_shelf", "object.posemode_toggle"),
    ):
        layout = Layout()
        pose_panel.draw_pose(layout, addon)
        assert button in layout.of("button", "prop")
        assert other not in layout.of("button", "prop")
        bpy.ops.object.posemode_toggle()


def test_the_panel_offers_to_add_handles_or_else_to_bake_them(addon, armature):
    drawn = set(shown(pose_panel.draw_pose, addon))
    assert "primdiffusion.add_handles" in drawn
    assert "primdiffusion.bake_handles" not in drawn
    assert ops.add_handles() == {"FINISHED"}
    drawn = set(shown(pose_panel.draw_pose, addon))
    assert "primdiffusion.bake_handles" in drawn
    assert "primdiffusion.add_handles" not in drawn
    assert ops.bake_handles() == {"FINISHED"}
    assert not has_handles(armature)
    with pytest.raises(RuntimeError, match="no IK handles"):
        ops.bake_handles()


def test_motions_wait_until_handles_are_baked(armature):
    ops.add_motion(motion="WAVE", rounds=1)
    ops.add_handles()
    action = armature.animation_data.action
    with pytest.raises(RuntimeError, match="has IK handles"):
        ops.add_motion(motion="WALK")
    assert armature.animation_data.action == action
    ops.bake_handles()
    assert ops.add_motion(motion="WALK") == {"FINISHED"}


def test_undo_takes_handles_away_and_brings_them_back(addon, armature):
    pose_from_library(armature, "Walking")
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
