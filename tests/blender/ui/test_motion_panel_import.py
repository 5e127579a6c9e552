"""Import Motion: rate, range, root, and what is rejected."""

import pickle
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import synthetic
from amass_files import feet, write_amass
from blender_primdiffusion.formats.poses.files import read_motion
from blender_primdiffusion.formats.poses.rotation import about_axis
from support.errors import refused

from blender_primdiffusion.motion.poses import current_pose
from blender_primdiffusion.scene.actions import action_curves
from blender_primdiffusion.scene.armature import build_armature
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.convention import points_to_blender
from blender_primdiffusion.ui.motion_panel import PRIMDIFFUSION_OT_import_motion

pytestmark = pytest.mark.any_blender

ops = bpy.ops.primdiffusion


def test_amass_comes_in_at_the_scenes_rate_on_the_floor_from_where_the_person_is(addon, armature, tmp_path):
    addon.scene.render.fps, addon.scene.render.fps_base = 24, 1.001
    path = write_amass(tmp_path / "läufer 1.npz", frames=241)
    assert ops.import_motion(filepath=path, start=10) == {"FINISHED"}
    action = armature.animation_data.action
    assert action.name == "läufer 1"
    keys = action_curves(armature)[0].keyframe_points
    assert (keys[0].co[0], len(keys)) == (10, int(2 * 24 / 1.001) + 1)
    addon.scene.frame_set(10)
    assert current_pose(armature)[1][[0, 2]] == pytest.approx([0, 0], abs=1e-6)
    assert feet(armature).min() == pytest.approx(0, abs=0.05)
    addon.scene.frame_set(34)
    moved = read_motion(path)
    assert current_pose(armature)[1][0] == pytest.approx(0.5, abs=0.01)
    np.testing.assert_allclose(
        current_pose(armature)[0][4], moved.rotations[round(24 * 1.001 / 24 * 120)][4], atol=0.02
    )
    assert addon.scene.frame_end >= 34


def test_the_rate_can_be_corrected(addon, armature, tmp_path):
    addon.scene.render.fps = 24
    ops.import_motion(filepath=write_amass(tmp_path / "m.npz"), fps=48.0, start=1)
    assert len(action_curves(armature)[0].keyframe_points) == 16


def test_part_of_a_file(addon, armature, tmp_path):
    ops.import_motion(filepath=write_amass(tmp_path / "m.npz"), fps=24.0, first=11, last=20)
    assert len(action_curves(armature)[0].keyframe_points) == 10
    with refused(RuntimeError, "40 to 31"):
        ops.import_motion(filepath=write_amass(tmp_path / "m.npz"), first=40)


def test_root_motion_can_be_kept_or_left_out(addon, armature, tmp_path):
    path = write_amass(tmp_path / "m.npz")
    ops.import_motion(filepath=path, root="KEEP", ground=False, fit_stride=False, start=1)
    addon.scene.frame_set(1)
    np.testing.assert_allclose(current_pose(armature)[1], read_motion(path).translations[0], atol=1e-4)
    ops.import_motion(filepath=path, root="PLACE")
    for frame in (1, 4):
        addon.scene.frame_set(frame)
        assert current_pose(armature)[1][[0, 2]] == pytest.approx([0, 0], abs=1e-6)


def test_the_up_axis_can_be_given(addon, armature, tmp_path):
    np.savez(tmp_path / "p.npz", pose=np.zeros((2, 72)))
    ops.import_motion(filepath=str(tmp_path / "p.npz"), up="Z")
    addon.scene.frame_set(1)
    np.testing.assert_allclose(current_pose(armature)[0][0], about_axis(0, -np.pi / 2), atol=1e-6)


def test_edit_mode_renamed_bones_and_linked_armatures_are_rejected_by_name(addon, armature, tmp_path):
    path = write_amass(tmp_path / "m.npz")
    addon.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    with refused(RuntimeError, "Edit Mode"):
        ops.import_motion(filepath=path)
    bpy.ops.object.mode_set(mode="OBJECT")
    armature.data.bones["left_knee"].name = "Knie"
    with refused(RuntimeError, "left_knee"):
        ops.import_motion(filepath=path)
    armature.data.bones["Knie"].name = "left_knee"
    bpy.data.libraries.write(str(tmp_path / "lib.blend"), {armature})
    with bpy.data.libraries.load(str(tmp_path / "lib.blend"), link=True) as (source, target):
        target.objects = source.objects
    linked = next(obj for obj in target.objects if obj.type == "ARMATURE")
    addon.scene.collection.objects.link(linked)
    addon.view_layer.objects.active = linked
    with refused(RuntimeError, "linked"):
        ops.import_motion(filepath=path)


def test_any_armature_with_smpls_joints_can_be_moved(addon, tmp_path):
    other = build_armature("SMPL", points_to_blender(synthetic.joints()))
    addon.scene.collection.objects.link(other)
    addon.view_layer.objects.active = other
    assert ops.import_motion(filepath=write_amass(tmp_path / "m.npz")) == {"FINISHED"}
    assert other.animation_data.action is not None


def test_of_two_people_the_named_one_moves(addon, armature, tmp_path):
    other = build_human(addon, synthetic.write(tmp_path / "q", 8), "Bob")
    ops.import_motion(filepath=write_amass(tmp_path / "m.npz"), human="Bob")
    assert armature.animation_data is None or armature.animation_data.action is None
    assert other.animation_data.action is not None
    with refused(RuntimeError, "Eve"):
        ops.import_motion(filepath=write_amass(tmp_path / "m.npz"), human="Eve")


def test_one_undo_takes_an_imported_motion_back(addon, armature, tmp_path):
    assert "UNDO" in PRIMDIFFUSION_OT_import_motion.bl_options
    bpy.ops.ed.undo_push(message="before")
    ops.import_motion(filepath=write_amass(tmp_path / "m.npz"))
    bpy.ops.ed.undo_push(message="Import Motion")
    bpy.ops.ed.undo()
    assert not bpy.data.actions


def test_a_scaled_armature_and_other_units_change_nothing_in_its_own_space(addon, armature, tmp_path):
    addon.scene.unit_settings.scale_length = 0.01
    armature.scale = (2, 2, 2)
    ops.import_motion(filepath=write_amass(tmp_path / "m.npz"), fps=24.0, start=1)
    addon.scene.frame_set(31)
    assert current_pose(armature)[1][0] == pytest.approx(1.0, abs=1e-4)


def test_files_are_dropped_onto_the_import(addon):
    handler = bpy.types.PRIMDIFFUSION_FH_motion
    assert handler.bl_import_operator == PRIMDIFFUSION_OT_import_motion.bl_idname
    assert set(handler.bl_file_extensions.split(";")) == {".npz", ".pkl", ".bvh"}
    assert handler.poll_drop(SimpleNamespace(area=SimpleNamespace(type="VIEW_3D")))
    assert not handler.poll_drop(SimpleNamespace(area=SimpleNamespace(type="IMAGE_EDITOR")))


def test_a_person_of_a_trackers_file_is_chosen_among_those_that_an_error_lists(addon, armature, tmp_path):
    path, theta = tmp_path / "wham_output.pkl", np.random.default_rng(2).normal(0, 0.2, (5, 72))
    path.write_bytes(pickle.dumps({0: {"pose_world": theta}, 4: {"pose_world": theta[:3] * 0.5}}))
    ops.import_motion(filepath=str(path), tracked_person="4", fps=24.0)
    assert len(action_curves(armature)[0].keyframe_points) == 3
    with refused(RuntimeError, "'9'", "4 (3 frames)"):
        ops.import_motion(filepath=str(path), tracked_person="9")


def test_a_motion_in_which_nobody_stands_is_called_doubtful_until_the_axis_is_set(addon, armature, tmp_path, capfd):
    theta = np.zeros((2, 24, 3))
    theta[:, 1:3, 0] = -2.0
    np.savez(tmp_path / "m.npz", poses=theta.reshape(2, 72), trans=np.zeros((2, 3)))
    for up, doubtful in (("AUTO", True), ("Y", False)):
        ops.import_motion(filepath=str(tmp_path / "m.npz"), up=up)
        assert ("set the up axis by hand" in capfd.readouterr().out) == doubtful
