"""BVH files of other rigs, other rests, other units and Euler orders: the same motion on SMPL's skeleton."""

import re

import bpy
import numpy as np
import pytest
import scan_fixtures
from blender_primdiffusion.files.regular_files import FileError
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.bvh import parse_bvh
from blender_primdiffusion.formats.poses.files import read_motion
from blender_primdiffusion.formats.poses.rigs import map_bones
from blender_primdiffusion.formats.poses.rotation import about_axis, axis_direction, between, to_axis_angle
from blender_primdiffusion.formats.poses.skeleton import REST_JOINTS, chain, joint_positions
from bvh_files import FRAMES, along_x, motion_of, write_bvh
from support.errors import refused

from blender_primdiffusion.scene.armature import build_armature, keyframe_poses
from blender_primdiffusion.scene.convention import points_to_blender

pytestmark = pytest.mark.any_blender


def test_euler_channels_are_read_in_the_order_they_are_written(tmp_path):
    rotations, moves = motion_of(1.5)
    path = write_bvh(tmp_path / "m.bvh", REST_JOINTS, rotations, moves, scan_fixtures.MIXAMO)
    hierarchy = parse_bvh(path)
    turned, places = hierarchy.world()
    index = [hierarchy.names.index(scan_fixtures.MIXAMO[name]) for name in JOINT_NAMES]
    np.testing.assert_allclose(turned[:, index], chain(rotations), atol=1e-6)
    np.testing.assert_allclose(places, moves, atol=1e-6)
    np.testing.assert_allclose(hierarchy.rest()[index], REST_JOINTS, atol=1e-6)


RIGS = ["MIXAMO", "RPM", "UNREAL", "RIGIFY", "RENDERPEOPLE", "SOMA", "VROID", "MOCAPNET", "ROKOKO", "OWN"]


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("unit", [1.0, 100.0])
def test_a_rig_at_smpls_rest_gives_smpls_rotations(tmp_path, rig, unit):
    rotations, moves = motion_of()
    names = getattr(scan_fixtures, rig)
    found = map_bones(names.values())
    rotations[:, [joint for joint, name in enumerate(JOINT_NAMES) if name not in found.joints]] = np.eye(3)
    rotations[:, [JOINT_NAMES.index("left_hand"), JOINT_NAMES.index("right_hand")]] = np.eye(3)
    root = (REST_JOINTS[0] + moves) * unit
    path = write_bvh(tmp_path / "m.bvh", REST_JOINTS * unit, rotations, root, names)
    motion = read_motion(path)
    np.testing.assert_allclose(motion.rotations, rotations, atol=1e-6)
    np.testing.assert_allclose(motion.translations, moves, atol=1e-5)
    assert motion.fps == pytest.approx(120, abs=0.01)
    assert motion.detected.unit.startswith("metres" if unit == 1 else "centimetres")
    assert motion.detected.doubt == ""


def standing_first(spread: float = 0.5) -> np.ndarray:
    """A motion of people who bend and turn, whose third frame is close to the T pose."""
    rotations, _ = motion_of(spread, 4)
    rotations[2] = np.eye(3)
    return rotations


def test_bones_along_one_axis_at_rest_still_give_a_standing_person(tmp_path):
    rotations, root = standing_first(), np.tile(REST_JOINTS[0], (FRAMES, 1))
    rotations[:, 22:] = np.eye(3)
    path = write_bvh(tmp_path / "m.bvh", *along_x(REST_JOINTS, rotations), root, scan_fixtures.ROKOKO)
    motion = read_motion(path)
    assert np.abs(motion.joints() - joint_positions(rotations)).max() < 0.005
    assert motion.detected.up == "y"


@pytest.mark.parametrize("up", ["y", "z", "-y", "x"])
def test_the_up_axis_of_such_a_file_is_that_along_which_the_person_stands(tmp_path, up):
    turn = between(np.array([0.0, 1, 0]), axis_direction(up))
    rotations, root = standing_first(), np.tile(REST_JOINTS[0], (FRAMES, 1))
    rotations[:, 22:] = np.eye(3)
    flat, turned = along_x(REST_JOINTS, rotations)
    turned[:, 0] = turn @ turned[:, 0]
    motion = read_motion(write_bvh(tmp_path / "m.bvh", flat, turned, root @ turn.T, scan_fixtures.ROKOKO))
    places = motion.joints() - motion.joints()[:, :1]
    height = joint_positions(rotations)[..., 1] - joint_positions(rotations)[:, :1, 1]
    assert motion.detected.up == up
    assert np.abs(places[..., 1] - height).max() < 0.005


def test_a_rest_of_bones_along_one_axis_whose_person_never_stands_is_an_error(tmp_path):
    rotations = np.tile(np.eye(3), (FRAMES, 24, 1, 1))
    rotations[:, [JOINT_NAMES.index("left_hip"), JOINT_NAMES.index("right_hip")]] = about_axis(0, -1.7)
    root = np.tile(REST_JOINTS[0], (FRAMES, 1))
    path = write_bvh(tmp_path / "m.bvh", *along_x(REST_JOINTS, rotations), root, scan_fixtures.ROKOKO)
    with refused(FileError, "m.bvh", "no frame in which one stands"):
        read_motion(path)


def test_who_stands_in_no_frame_is_read_with_a_doubt_and_by_hand_as_told(tmp_path):
    rotations, moves = motion_of(0.05)
    rotations[:, [JOINT_NAMES.index("left_hip"), JOINT_NAMES.index("right_hip")]] = about_axis(0, -2.0)
    path = write_bvh(tmp_path / "m.bvh", REST_JOINTS, rotations, REST_JOINTS[0] + moves, scan_fixtures.MIXAMO)
    found = read_motion(path)
    assert "stands in no frame" in found.detected.doubt
    by_hand = read_motion(path, up="z")
    assert by_hand.detected.up == "z"
    np.testing.assert_allclose(by_hand.rotations[:, 0], about_axis(0, -np.pi / 2) @ rotations[:, 0], atol=1e-6)
    assert by_hand.detected.doubt == ""


def test_an_axis_set_by_hand_holds_for_a_rest_that_faces_between_two_axes(tmp_path):
    turn = about_axis(1, 0.7)
    rotations, moves = motion_of()
    rotations[:, 22:] = np.eye(3)
    root = (REST_JOINTS[0] + moves) @ turn.T
    path = write_bvh(tmp_path / "m.bvh", REST_JOINTS @ turn.T, turn @ rotations @ turn.T, root, scan_fixtures.MIXAMO)
    upright, lying = read_motion(path, up="y"), read_motion(path, up="x")
    np.testing.assert_allclose(upright.rotations, rotations, atol=1e-3)
    x_in_person = turn.T @ np.array([1.0, 0, 0])
    heights = (joint_positions(rotations) - joint_positions(rotations)[:, :1]) @ x_in_person
    assert np.abs((lying.joints() - lying.joints()[:, :1])[..., 1] - heights).max() < 0.005


def test_who_lies_down_for_most_of_a_motion_does_not_turn_the_world(tmp_path):
    rotations = np.tile(np.eye(3), (FRAMES, 24, 1, 1))
    rotations[2:, 0] = about_axis(0, -1.5)
    root = np.tile(REST_JOINTS[0], (FRAMES, 1))
    path = write_bvh(tmp_path / "m.bvh", REST_JOINTS, rotations, root, scan_fixtures.MIXAMO)
    assert read_motion(path).detected.up == "y"


def test_missing_joints_and_bones_are_listed_by_whole_words():
    bones = [f"a_bone_with_a_long_name_{number}" for number in range(30)]
    with refused(ValueError, "'pelvis', 'left_hip', 'right_hip'", "and 10 more", repr(bones[0]), "and 29 more"):
        map_bones(bones)


def test_a_rig_at_an_a_rest_puts_the_joints_where_the_file_has_them(tmp_path):
    rest = joint_positions(scan_fixtures.a_pose())
    rotations, _ = motion_of(0.25, 1)
    path = write_bvh(tmp_path / "m.bvh", rest, rotations, np.tile(rest[0], (FRAMES, 1)), scan_fixtures.MIXAMO)
    there = joint_positions(rotations, rest=rest)
    here = read_motion(path).joints()
    limbs = [JOINT_NAMES.index(n) for n in JOINT_NAMES if n.split("_")[-1] not in ("hand",)]
    assert np.linalg.norm(here - there, axis=-1)[:, limbs].max() < 0.005


def test_a_rest_facing_another_way_with_z_up_gives_the_same_motion(tmp_path):
    turn = about_axis(2, 1.2) @ about_axis(0, np.pi / 2)  # z up, then away from the front
    rotations, moves = motion_of()
    rotations[:, 22:] = np.eye(3)
    path = write_bvh(
        tmp_path / "m.bvh", REST_JOINTS @ turn.T, turn @ rotations @ turn.T, (REST_JOINTS[0] + moves) @ turn.T,
        scan_fixtures.MIXAMO,
    )  # fmt: skip
    motion = read_motion(path)
    np.testing.assert_allclose(motion.rotations, rotations, atol=1e-3)  # the facing is that of hips and shoulders
    np.testing.assert_allclose(motion.translations, moves, atol=1e-3)


def test_a_rig_without_toes_and_fingers_moves_its_limbs_all_the_same(tmp_path):
    left_out = ("left_foot", "right_foot", "left_hand", "right_hand")
    rotations, _ = motion_of()
    rotations[:, [JOINT_NAMES.index(name) for name in left_out]] = np.eye(3)
    path = write_bvh(
        tmp_path / "m.bvh", REST_JOINTS, rotations, np.tile(REST_JOINTS[0], (FRAMES, 1)), scan_fixtures.MIXAMO, left_out
    )
    found = read_motion(path).rotations
    np.testing.assert_allclose(found[:, :20], rotations[:, :20], atol=1e-6)
    np.testing.assert_allclose(found[:, 20:], rotations[:, 20:], atol=0.06)  # hands point along the end site


def test_blenders_own_export_comes_back(tmp_path, empty_scene):
    armature = build_armature("rig", points_to_blender(REST_JOINTS))
    empty_scene.scene.collection.objects.link(armature)
    rotations, moves = motion_of()
    rotations[:, 22:] = np.eye(3)
    keyframe_poses(armature, np.arange(1, FRAMES + 1), rotations, moves)
    empty_scene.scene.frame_end = FRAMES
    for name, other in scan_fixtures.RIGIFY.items():
        armature.data.bones[name].name = other
    empty_scene.view_layer.objects.active = armature
    path = tmp_path / "blender.bvh"
    bpy.ops.export_anim.bvh(filepath=str(path), frame_start=1, frame_end=FRAMES)
    motion = read_motion(path)
    off = np.linalg.norm(to_axis_angle(np.swapaxes(motion.rotations, -1, -2) @ rotations), axis=-1)
    assert off.max() < 2e-3
    assert np.abs(motion.joints() - joint_positions(rotations, moves)).max() < 5e-3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("mixamorig:LeftUpLeg", "Bone.017"), "'left_hip'"),
        (lambda text: text.replace("Zrotation", "Wrotation"), "the channel 'Wrotation' is unknown"),
        (lambda text: text[: len(text) - 900], "numbers are announced"),
        (lambda text: text.replace("Frames: 6", "Frames: 0"), "0 frames"),
        (lambda text: text.replace("MOTION", "MOVES"), "no HIERARCHY followed by MOTION"),
        (lambda text: text.replace("}\nMOTION", "MOTION"), "a brace is not closed"),
        (lambda text: text.replace("Frame Time: 0.0083333\n", "Frame Time: 0.0083333\nnan "), "NaN or infinite"),
        (lambda text: text.replace("CHANNELS 3", "CHANNELS -2", 1), "-2 channels of a joint"),
        (
            lambda text: re.sub(r"CHANNELS .*", "CHANNELS 0", text).replace("Frames: 6", "Frames: 2000000"),
            "no joint has",
        ),
        (lambda text: text.replace("Frames: 6", "Frames: 1000000000000"), "cut the motion"),
        (lambda text: text.replace("Frames: 6", f"Frames: {'9' * 400}"), "Frames:"),
        (lambda text: text.replace("Time: 0.0083333", "Time: 1e-320"), "a frame time of"),
        (lambda text: text.replace("Time: 0.0083333", "Time: 1e300"), "a frame time of"),
        (lambda text: text.replace("Time: 0.0083333", "Time: nan"), "a frame time of"),
        (lambda text: text.replace("0.0083333\n", "0.0083333\n1e300 "), "not angles or lengths"),
        (lambda text: text.replace("0.0083333\n", "0.0083333\nword "), "a word where"),
        (lambda text: re.sub(r"OFFSET \S+", "OFFSET 1e200", text, count=1), "not angles or lengths"),
        (lambda text: text + "0 " * 2_000_000, "much more than the 6 frames of"),
        (lambda text: text.replace("MOTION", " JOINT a { " * 1001 + "MOTION"), "more than 1000 joints"),
    ],
)
def test_broken_files_are_named(tmp_path, change, message):
    rotations, moves = motion_of()
    path = write_bvh(tmp_path / "m.bvh", REST_JOINTS, rotations, moves, scan_fixtures.MIXAMO)
    path.write_text(change(path.read_text()))
    with refused(FileError, message, str(path)):
        read_motion(path)


def test_a_file_without_a_frame_time_gets_the_default(tmp_path):
    rotations, moves = motion_of()
    path = write_bvh(tmp_path / "m.bvh", REST_JOINTS, rotations, moves, scan_fixtures.MIXAMO, frame_time="0")
    motion = read_motion(path)
    assert motion.fps == 30
    assert motion.detected.fps == 0
