"""Files of poses as people have them, and files that hold something else."""

import json

import numpy as np
import pytest
from blender_primdiffusion.files.regular_files import FileError
from blender_primdiffusion.formats.poses.files import read_motion
from blender_primdiffusion.formats.poses.motion import DEFAULT_FPS
from blender_primdiffusion.formats.poses.rotation import about_axis, from_axis_angle, to_axis_angle
from blender_primdiffusion.formats.poses.skeleton import REST_JOINTS
from support.errors import refused

pytestmark = pytest.mark.any_blender

FRAMES = 7
RNG = np.random.default_rng(0)
THETA = RNG.normal(0, 0.3, (FRAMES, 24, 3))
MOVE = RNG.normal(0, 1, (FRAMES, 3))
Z_FROM_Y = about_axis(0, np.pi / 2)
"""Turns a world with y up into one with z up."""


def amass(numbers: int) -> dict[str, np.ndarray]:
    """What AMASS would hold of THETA and MOVE: z up, and `numbers` values a frame, the hands curled."""
    theta = THETA.copy()
    theta[:, 0] = to_axis_angle(Z_FROM_Y @ from_axis_angle(THETA[:, 0]))
    poses = np.full((FRAMES, numbers), 0.4)
    body = 72 if numbers == 72 else 66
    poses[:, :body] = theta.reshape(FRAMES, 72)[:, :body]
    trans = (MOVE + REST_JOINTS[0]) @ Z_FROM_Y.T - REST_JOINTS[0]
    return {"poses": poses, "trans": trans, "betas": np.zeros(16), "gender": np.array("neutral")}


@pytest.mark.parametrize("numbers", [72, 156, 165])
@pytest.mark.parametrize("rate", ["mocap_framerate", "mocap_frame_rate", "fps"])
def test_amass_is_read_with_y_up_and_without_hands(tmp_path, numbers, rate):
    path = tmp_path / "walk_poses.npz"
    np.savez(path, **amass(numbers), **{rate: np.array(120.0)})
    motion = read_motion(path)
    assert (motion.fps, motion.name) == (120.0, "walk_poses")
    assert motion.detected.up == "z"
    np.testing.assert_allclose(motion.translations, MOVE, atol=1e-9)
    expected = THETA.copy()
    if numbers != 72:
        expected[:, 22:] = 0
    np.testing.assert_allclose(motion.rotations, from_axis_angle(expected), atol=1e-9)


def test_amass_that_has_y_up_already_is_left_alone(tmp_path):
    np.savez(tmp_path / "m.npz", poses=THETA.reshape(FRAMES, 72), trans=MOVE, fps=np.array(60))
    motion = read_motion(tmp_path / "m.npz")
    np.testing.assert_allclose(motion.rotations, from_axis_angle(THETA), atol=1e-9)
    np.testing.assert_allclose(motion.translations, MOVE, atol=1e-9)
    assert motion.detected.up == "y"


def test_amass_without_a_rate_gets_the_default(tmp_path):
    np.savez(tmp_path / "m.npz", **amass(156))
    motion = read_motion(tmp_path / "m.npz")
    assert motion.fps == DEFAULT_FPS
    assert motion.detected.fps == 0


def test_smplx_by_parts_is_read(tmp_path):
    whole = amass(165)
    np.savez(
        tmp_path / "m.npz", root_orient=whole["poses"][:, :3], pose_body=whole["poses"][:, 3:66], trans=whole["trans"],
        mocap_frame_rate=np.array(30.0),
    )  # fmt: skip
    expected = THETA.copy()
    expected[:, 22:] = 0
    np.testing.assert_allclose(read_motion(tmp_path / "m.npz").rotations, from_axis_angle(expected), atol=1e-9)


def test_a_pose_npz_is_read_as_it_stands(tmp_path):
    np.savez(
        tmp_path / "p.npz", global_orient=THETA[:, 0], body_pose=THETA[:, 1:].reshape(FRAMES, 69), transl=MOVE,
        betas=np.zeros((1, 10)),
    )  # fmt: skip
    motion = read_motion(tmp_path / "p.npz")
    np.testing.assert_allclose(motion.axis_angle(), THETA, atol=1e-9)
    np.testing.assert_array_equal(motion.translations, MOVE)


@pytest.mark.parametrize("ending", ["npy", "npz", "json"])
@pytest.mark.parametrize(
    ("change", "is_read"),
    [
        (np.eye(3), True),
        (np.diag([1, 1, 1.0004]), True),
        (np.diag([1, 1, 1.001]), False),
        (np.array([[1, 2e-3, 0], [0, 1, 0], [0, 0, 1]]), False),
        (np.diag([1, 1, -1.0]), False),
        (np.zeros((3, 3)), False),
    ],
)
def test_a_matrix_is_a_rotation_within_a_thousandth_or_a_sentence(tmp_path, ending, change, is_read):
    matrices = from_axis_angle(THETA)
    matrices[1, 4] = matrices[1, 4] @ change
    path = tmp_path / f"p.{ending}"
    if ending == "json":
        path.write_text(json.dumps({"pose": matrices.tolist()}), encoding="utf-8")
    elif ending == "npy":
        np.save(path, matrices)
    else:
        np.savez(path, global_orient=matrices[:, 0], body_pose=matrices[:, 1:])
    if is_read:
        np.testing.assert_allclose(read_motion(path).rotations, from_axis_angle(THETA), atol=1e-3)
    else:
        with refused(FileError, f"p.{ending}", "left_knee", "frame 1"):
            read_motion(path)


@pytest.mark.parametrize("shape", [(FRAMES, 72), (FRAMES, 24, 3)])
def test_npy_of_many_frames_is_read(tmp_path, shape):
    np.save(tmp_path / "p.npy", THETA.reshape(shape))
    np.testing.assert_allclose(read_motion(tmp_path / "p.npy").axis_angle(), THETA, atol=1e-9)


@pytest.mark.parametrize("shape", [(72,), (24, 3), (1, 72)])
def test_npy_of_one_pose_is_read(tmp_path, shape):
    np.save(tmp_path / "p.npy", THETA[0].reshape(shape).astype(np.float32))
    motion = read_motion(tmp_path / "p.npy")
    np.testing.assert_allclose(motion.axis_angle()[0], THETA[0], atol=1e-6)
    assert motion.detected.doubt == ""


@pytest.mark.parametrize(
    "content",
    [
        THETA.reshape(FRAMES, 72).tolist(),
        {"poses": THETA.tolist(), "fps": 30},
        {"global_orient": THETA[:, 0].tolist(), "body_pose": THETA[:, 1:].reshape(FRAMES, 69).tolist()},
    ],
)
def test_json_is_read(tmp_path, content):
    (tmp_path / "p.json").write_text(json.dumps(content))
    np.testing.assert_allclose(read_motion(tmp_path / "p.json").axis_angle(), THETA, atol=1e-9)


def test_the_released_plain_twin_is_read_and_the_pickled_one_rejected(tmp_path):
    from blender_primdiffusion.formats.capture_layout import SMPL_FILE, SMPL_FOLDER, SMPL_PLAIN_FILE, write_smpl

    write_smpl(tmp_path, THETA[:, 0], THETA[:, 1:].reshape(FRAMES, 69), np.zeros(10), MOVE)
    motion = read_motion(tmp_path / SMPL_FOLDER / SMPL_PLAIN_FILE)
    np.testing.assert_allclose(motion.axis_angle(), THETA, atol=1e-6)
    with refused(FileError):
        read_motion(tmp_path / SMPL_FOLDER / SMPL_FILE)


def test_one_translation_serves_all_frames(tmp_path):
    np.savez(tmp_path / "p.npz", pose=THETA.reshape(FRAMES, 72), transl=np.array([1.0, 2, 3]))
    np.testing.assert_array_equal(read_motion(tmp_path / "p.npz").translations, np.tile([1.0, 2, 3], (FRAMES, 1)))


@pytest.mark.parametrize(
    ("arrays", "name"),
    [
        ({"poses": np.full((3, 72), np.nan), "trans": np.zeros((3, 3))}, "'poses'"),
        ({"poses": np.zeros((3, 72)), "trans": np.full((3, 3), np.inf)}, "'trans'"),
        ({"poses": np.zeros((3, 60))}, "20 joints"),
        ({"poses": np.zeros((3, 71))}, "72"),
        ({"poses": np.zeros((0, 72))}, "no frame"),
        ({"poses": np.array(["a"] * 72)[None]}, "numbers"),
        ({"poses": np.zeros((3, 72)), "trans": np.zeros((4, 3))}, "translations"),
        ({"poses": np.array([{"a": 1}], object)}, "pickled"),
        ({"body_pose": np.zeros((3, 69)), "global_orient": np.zeros((2, 3))}, "global_orient"),
        ({"body_pose": np.ones((3, 23, 3, 3))}, "left_hip"),
        ({"marker_data": np.zeros((3, 72))}, "'marker_data'"),
        ({"poses": np.full((2, 72), 1e300)}, "bad.npz"),
        ({"poses": np.zeros((2, 72)), "trans": np.full((2, 3), 1e300)}, "bad.npz"),
        ({"poses": np.zeros((2, 72)), "fps": np.array(1e-300)}, "bad.npz"),
        ({"poses": np.zeros((2, 72)), "fps": np.array(1e9)}, "bad.npz"),
    ],
)
def test_arrays_that_are_no_poses_are_named(tmp_path, arrays, name):
    np.savez(tmp_path / "bad.npz", **arrays)
    with refused(FileError, name):
        read_motion(tmp_path / "bad.npz")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.npy", b"\x93NUMPY\x01\x00 nothing"),
        ("a.json", b'{"pose": [1, 2, [3]]}'),
        ("a.json", b'{"angles": [1]}'),
        ("a.json", b"[NaN" + b", 0" * 71 + b"]"),
        ("a.json", b"[" + b"1" * 400 + b", 0" * 71 + b"]"),
        ("a.json", b"[1e999]"),
        ("a.bvh", b"HIERARCHY\nROOT hip\n{\n OFFSET 0 0 0\n"),
        ("a.pkl", b""),
    ],
)
def test_files_that_are_broken_are_named(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with refused(FileError, str(tmp_path / name)) as caught:
        read_motion(tmp_path / name)
    assert len(str(caught.value)) < 300
