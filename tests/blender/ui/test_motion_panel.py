"""Built-in motions, export and the Motion panel, as the user meets them."""

import bpy
import numpy as np
import pytest
import synthetic
from amass_files import feet, write_amass
from blender_primdiffusion.formats.poses.files import read_motion
from jobs_driven import Layout
from support.errors import refused

from blender_primdiffusion.motion.poses import current_pose
from blender_primdiffusion.scene.actions import action_curves
from blender_primdiffusion.ui.motion_panel import draw_motion

ops = bpy.ops.primdiffusion


def last_key(armature) -> float:
    return max(curve.keyframe_points[-1].co[0] for curve in action_curves(armature))


@pytest.mark.any_blender
def test_built_in_motion_fits_long_and_short_legs(addon, armature):
    ops.add_motion(motion="WALK", rounds=1, speed=2.0)
    heights = []
    for frame in range(1, int(last_key(armature)) + 1):
        addon.scene.frame_set(frame)
        heights.append(feet(armature).min())
    assert min(heights) > -0.05
    assert max(heights) < 0.03


@pytest.mark.any_blender
@pytest.mark.parametrize("fps", [24, 25, 60])
@pytest.mark.parametrize("motion", ["WALK", "IDLE", "WAVE"])
def test_a_round_ends_on_a_whole_frame_as_it_began(addon, armature, motion, fps):
    addon.scene.render.fps = fps
    ops.add_motion(motion=motion, rounds=2)
    assert last_key(armature).is_integer()
    for curve in action_curves(armature):
        if "rotation" in curve.data_path:
            first, last = (curve.keyframe_points[end].co[1] for end in (0, -1))
            assert abs(first) == pytest.approx(abs(last), abs=1e-5)


def test_exported_motion_comes_back_the_same(addon, armature, tmp_path):
    ops.add_motion(motion="WALK", rounds=1)
    out = tmp_path / "mit Umläuten" / "walk.npz"
    out.parent.mkdir()
    assert ops.export_motion(filepath=str(out), first=1, last=27) == {"FINISHED"}
    back = read_motion(out)
    assert back.fps == pytest.approx(24)
    assert back.detected.up == "z"
    places = []
    for frame in (1, 14, 27):
        addon.scene.frame_set(frame)
        rotations, place = current_pose(armature)
        places.append(place)
        np.testing.assert_allclose(back.rotations[frame - 1], rotations, atol=1e-5)
    np.testing.assert_allclose(np.diff(back.translations[[0, 13, 26]], axis=0), np.diff(places, axis=0), atol=1e-5)
    with np.load(out) as arrays:
        np.testing.assert_allclose(arrays["betas"], armature["primdiffusion_betas"])
        assert arrays["poses"].shape == (27, 72)
    assert len(bpy.data.scenes) == 1


@pytest.mark.any_blender
def test_exported_translations_are_of_smpls_own_body_wherever_the_armature_has_its_origin(addon, armature, tmp_path):
    armature.location = (1.0, 2.0, 3.0)
    ops.export_motion(filepath=str(tmp_path / "rest.npz"), first=1, last=1)
    pelvis = synthetic.joints()[0]
    upright = np.array([pelvis[0], -pelvis[2], pelvis[1]])
    with np.load(tmp_path / "rest.npz") as arrays:
        np.testing.assert_allclose(pelvis + arrays["trans"][0], upright, atol=1e-6)


@pytest.mark.any_blender
def test_export_counts_constraints_and_rejects_an_empty_range(addon, armature, tmp_path):
    constraint = armature.pose.bones["head"].constraints.new("LIMIT_ROTATION")
    constraint.use_limit_y = True
    constraint.owner_space = "LOCAL"
    armature.pose.bones["head"].rotation_quaternion = (0.9, 0, 0.4, 0)
    ops.export_motion(filepath=str(tmp_path / "m.npz"), first=1, last=1)
    turn = read_motion(tmp_path / "m.npz").axis_angle()[0]
    assert np.abs(turn).max() < 1e-4
    with refused(RuntimeError, "frame 2", "5"):
        ops.export_motion(filepath=str(tmp_path / "m.npz"), first=5, last=2)


def texts(context) -> list[str]:
    layout = Layout()
    draw_motion(layout, context)
    return layout.of("text", "prop", "button")


def test_an_import_says_what_was_found_and_the_panel_shows_the_frames(addon, armature, tmp_path, capfd):
    ops.import_motion(filepath=write_amass(tmp_path / "m.npz"), start=3)
    first, last = armature.animation_data.action.frame_range
    assert f"m (SMPL-H, z up, 120 fps): 31 frames on frames 3 to {last:g}" in capfd.readouterr().out
    assert f"Frames {first:g} \N{EN DASH} {last:g}" in texts(addon)
