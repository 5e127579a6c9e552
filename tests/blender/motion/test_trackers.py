"""Outputs of trackers of people: one level down, several people, frame by frame, of joblib and pickle."""

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blender_primdiffusion.files.regular_files import FileError
from blender_primdiffusion.formats.poses.files import read_motion
from blender_primdiffusion.formats.poses.rotation import about_axis, from_axis_angle
from support.errors import refused
from support.joblib_files import dumped

pytestmark = pytest.mark.any_blender

RNG = np.random.default_rng(0)
FRAMES = 5
THETA = RNG.normal(0, 0.25, (3, FRAMES, 24, 3))
"""Of three people."""
MOVE = RNG.normal(0, 1, (FRAMES, 3))
IN_CAMERA = about_axis(0, np.pi)
"""Turns a world with y up into a camera's axes, y down."""
WRITERS = {"pickle": pickle.dumps, "joblib": dumped, "compressed": lambda content: dumped(content, compressed=True)}


def write(path: Path, content: Any, kind: str = "pickle") -> Path:
    path.write_bytes(WRITERS[kind](content))
    return path


def wham(frames: dict[int, int]) -> dict[int, dict[str, np.ndarray]]:
    """What WHAM writes: numbers of people -> their arrays, in the camera's axes and in the world's."""
    people = {}
    for person, (number, count) in enumerate(frames.items()):
        theta = THETA[person, :count].reshape(count, 72)
        people[number] = {
            "pose": theta + 0.5, "trans": MOVE[:count] + 9, "pose_world": theta, "trans_world": MOVE[:count],
            "betas": np.zeros((count, 10)), "frame_ids": np.arange(count),
        }  # fmt: skip
    return people


def phalp(frames: int = FRAMES) -> dict[str, dict[str, Any]]:
    """What PHALP writes: two people, of whom the second is not in the first frame, in the camera's axes."""
    content = {}
    for frame in range(frames):
        numbers = [7] if frame == 0 else [12, 7]
        content[f"_DEMO/a/img/{frame:06d}.jpg"] = {
            "time": frame, "tracked_ids": numbers, "tid": numbers, "bbox": [np.zeros(4)] * len(numbers),
            "smpl": [parameters(0 if number == 7 else 1, frame) for number in numbers],
        }  # fmt: skip
    return content


def parameters(person: int, frame: int) -> dict[str, np.ndarray]:
    rotations = from_axis_angle(THETA[person, frame])
    return {
        "global_orient": (IN_CAMERA @ rotations[:1]).astype(np.float32),
        "body_pose": rotations[1:].astype(np.float32),
        "betas": np.zeros(10, np.float32),
    }


def assert_same(rotations: np.ndarray, theta: np.ndarray, joints: int = 24) -> None:
    np.testing.assert_allclose(rotations[:, :joints], from_axis_angle(theta)[:, :joints], atol=1e-5)


@pytest.mark.parametrize("kind", ["pickle", "joblib"])
def test_gvhmrs_world_is_read_one_level_down(tmp_path, kind):
    own = {
        "global_orient": THETA[0, :, 0].astype(np.float32), "transl": MOVE.astype(np.float32),
        "body_pose": THETA[0, :, 1:22].reshape(FRAMES, 63).astype(np.float32), "betas": np.zeros((FRAMES, 10)),
    }  # fmt: skip
    in_camera = own | {"global_orient": own["global_orient"] + 1}
    content = {"smpl_params_incam": in_camera, "smpl_params_global": own, "K_fullimg": np.zeros((FRAMES, 3, 3))}
    motion = read_motion(write(tmp_path / "hmr4d.pkl", content, kind))
    assert_same(motion.rotations, THETA[0], 22)
    np.testing.assert_allclose(motion.translations, MOVE, atol=1e-6)
    assert motion.detected.people == ("smpl_params_global",)


@pytest.mark.parametrize("kind", WRITERS)
def test_of_several_people_the_longest_is_read_and_all_are_listed(tmp_path, kind):
    path = write(tmp_path / "wham_output.pkl", wham({0: 3, 4: 5, 17: 2}), kind)
    motion = read_motion(path)
    assert_same(motion.rotations, THETA[1])
    np.testing.assert_allclose(motion.translations, MOVE)
    assert motion.detected.people == ("0", "4", "17")


def test_a_person_can_be_chosen(tmp_path):
    path = write(tmp_path / "wham_output.pkl", wham({0: 3, 4: 5, 17: 2}))
    assert_same(read_motion(path, person="17").rotations, THETA[2, :2])
    with refused(FileError, "wham_output.pkl", "'5'", "4 (5 frames), 0 (3 frames), 17 (2 frames)"):
        read_motion(path, person="5")


@pytest.mark.parametrize("kind", WRITERS)
def test_frames_of_people_become_motions_of_each(tmp_path, kind):
    path = write(tmp_path / "demo_a.pkl", phalp(), kind)
    motion = read_motion(path)
    assert (len(motion), motion.detected.up, motion.detected.people) == (FRAMES, "-y", ("7", "12"))
    assert_same(motion.rotations, THETA[0])
    assert_same(read_motion(path, person="12").rotations, THETA[1, 1:])


def test_json_of_several_people_is_read(tmp_path):
    people = {name: {key: array.tolist() for key, array in own.items()} for name, own in wham({0: 3, 4: 5}).items()}
    (tmp_path / "a.json").write_text(json.dumps(people))
    assert_same(read_motion(tmp_path / "a.json", person="0").rotations, THETA[0, :3])


def test_an_array_of_joblib_by_columns_is_read(tmp_path):
    poses = np.asfortranarray(THETA[0].reshape(FRAMES, 72))
    assert_same(read_motion(write(tmp_path / "a.pkl", {"poses": poses}, "joblib")).rotations, THETA[0])


@pytest.mark.parametrize(
    "content",
    [
        dumped({"poses": np.array([{}], object)}),
        dumped({"poses": np.zeros((4, 72))})[:-900],
        dumped({"poses": np.zeros((4, 72))}, compressed=True)[:-20],
        dumped({"poses": np.zeros((3, 72))}).replace(b"K\x03KH\x86", b"K\xffKH\x86"),
        dumped({"poses": np.zeros((3, 72))}).replace(b"K\x03KH\x86", b"JHHHHK\x03"),
        dumped({"poses": np.zeros((3, 72))}).replace(b"shape", b"shupe"),
        dumped({"poses": np.zeros((3, 72))}).replace(b"\x8c\x02f8", b"\x8c\x02O8"),
    ],
)
def test_damaged_files_of_joblib_are_one_sentence(tmp_path, content):
    (tmp_path / "a.pkl").write_bytes(content)
    with refused(FileError, "a.pkl") as caught:
        read_motion(tmp_path / "a.pkl")
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    "change",
    [
        lambda frame: frame["tid"].append(3),
        lambda frame: frame.update(smpl=np.zeros(3)),
        lambda frame: frame["smpl"][0].pop("body_pose"),
        lambda frame: frame["smpl"][0].update(body_pose=np.zeros(5)),
        lambda frame: frame["smpl"][1].update(body_pose=np.zeros((23, 3, 3))),
        lambda frame: frame["smpl"][0].update(body_pose="a"),
    ],
)
def test_frames_that_do_not_fit_are_one_sentence(tmp_path, change):
    content = phalp()
    change(content["_DEMO/a/img/000002.jpg"])
    with refused(FileError, "a.pkl"):
        read_motion(write(tmp_path / "a.pkl", content))


def test_torchs_files_are_refused_with_what_to_save(tmp_path):
    (tmp_path / "hmr4d_results.pt").write_bytes(b"PK")
    with refused(FileError, "hmr4d_results.pt", "PyTorch", ".npz"):
        read_motion(tmp_path / "hmr4d_results.pt")
