"""A capture goes on after a kill, finds damage, and leaves nothing behind in Blender."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import bpy
import numpy as np
import pytest
from blender_primdiffusion.files.regular_files import FileError
from blender_primdiffusion.files.whole_files import temporary_name
from blender_primdiffusion.formats.camera_rig import Rig
from blender_primdiffusion.formats.capture_layout import COMPLETE_FILE, LIST_FILE, RELEASED_REFERENCE, picture_path
from blender_primdiffusion.formats.poses.motion import Motion
from capture_child import PEOPLE, small
from capture_person import NamedPerson, files_of, load_painted, plain, two_poses
from support.capture_files import faults
from support.errors import refused

from blender_primdiffusion.capture import passes
from blender_primdiffusion.capture.job import _name_reference, run
from blender_primdiffusion.capture.settings import CaptureSettings
from blender_primdiffusion.capture.stage import data_blocks
from blender_primdiffusion.console import Report

pytestmark = pytest.mark.any_blender

POSES = two_poses()
VIEWS = 2 * 2


def capture(context, settings: CaptureSettings, people=PEOPLE, load=load_painted, poses=POSES) -> Report:
    report = Report()
    for _ in run(context, settings, people, report, poses=poses, load=load):
        pass
    return report


def start_child(out: Path) -> subprocess.Popen:
    command = [sys.executable, str(Path(__file__).parents[1] / "capture_child.py"), str(out)]
    here = Path(__file__).parents[1]
    path = [str(here), str(here.parent), str(here.parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path)}
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A capture that nothing disturbed."""
    out = tmp_path_factory.mktemp("whole") / "captures"
    bpy.ops.wm.read_factory_settings(use_empty=True)
    report = capture(bpy.context, small(out))
    assert report.done == ["anna", "bert"]
    assert report.failed == []
    return out


@pytest.fixture
def copy(whole, tmp_path) -> Path:
    out = tmp_path / "copy"
    for name, content in files_of(whole).items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(content)
    return out


def test_the_layout_is_complete(whole):
    assert not faults(whole)
    assert (whole / LIST_FILE).read_text().split() == ["anna", "bert"]
    names = set(files_of(whole / "anna"))
    pictures = {
        picture_path(Path(), kind, camera, frame).as_posix()
        for kind in ("img", "mask", "depth", "normal", "part")
        for camera in range(2)
        for frame in range(2)
    }
    others = {"cameras.json", "joints.npz", COMPLETE_FILE}
    others |= {f"outputs_re_fitting/refit_smpl_2nd{plain}.npz" for plain in ("", "_plain")}
    assert names == pictures | others
    report = json.loads((whole / "report.json").read_text())
    assert (report["done"], report["failed"], report["skipped"]) == (["anna", "bert"], [], [])


def test_joints_are_those_of_the_body_in_every_picture(whole):
    with np.load(whole / "anna/joints.npz") as joints:
        assert joints["world"].shape == (2, 24, 3)
        assert joints["pixel"].shape == (2, 2, 24, 2)
        cameras = json.loads((whole / "anna/cameras.json").read_text())
        k, r, t = (np.array(cameras["camera0001"][key]) for key in "KRT")
        in_camera = joints["world"][1] @ r.T + t
        pixel = in_camera @ k.T
        assert np.allclose(pixel[:, :2] / pixel[:, 2:], joints["pixel"][1, 1], atol=1e-3)
        assert np.allclose(in_camera[:, 2], joints["depth"][1, 1], atol=1e-5)


def test_a_killed_capture_continues_and_ends_in_the_same_files(whole, empty_scene, tmp_path):
    out = tmp_path / "captures"
    child = start_child(out)
    assert child.stderr is not None
    for line in child.stderr:
        if line.strip() == f"view {VIEWS + 1}":
            break
    else:
        pytest.fail(f"the child never came so far: {line}")
    time.sleep(0.02)  # in the midst of a view
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    child.stderr.close()
    before = {path: path.stat().st_mtime_ns for path in out.rglob("camera*/[!.]*.jpg")}
    capture(empty_scene, small(out))
    for path, written in before.items():
        assert path.stat().st_mtime_ns == written  # what was whole is not rendered again
    ours, undisturbed = files_of(out), files_of(whole)
    for name in ("report.json",):
        ours.pop(name), undisturbed.pop(name)
    assert ours == undisturbed


def test_what_is_done_is_skipped(copy, empty_scene, monkeypatch):
    monkeypatch.setattr("blender_primdiffusion.capture.job.load_scan", None)
    report = capture(empty_scene, small(copy), load=lambda *_: pytest.fail("somebody was loaded"))
    assert report.skipped == ["anna", "bert"]


def test_nothing_stays_in_the_file(empty_scene, tmp_path):
    mine = bpy.data.meshes.new("mine")
    before = {(block.id_type, block.name) for block in data_blocks()}
    steps = run(empty_scene, small(tmp_path / "a"), PEOPLE, poses=POSES, load=load_painted)
    next(steps)
    assert bpy.context.scene.name == "Scene"
    plain((1, 0, 0)).name = "made by the user meanwhile"
    next(steps)
    steps.close()  # that is: cancelled
    after = {(block.id_type, block.name) for block in data_blocks()}
    assert after - before == {("MATERIAL", "made by the user meanwhile")}
    assert before <= after
    assert mine.name == "mine"
    assert not list(Path(bpy.app.tempdir).glob("primdiffusion_capture_*"))


def test_a_failing_subject_does_not_affect_the_others(empty_scene, tmp_path):
    def load(context, scan_file, body):
        if scan_file.name == "anna":
            raise ValueError("anna.glb holds no person: export it again")
        return load_painted(context, scan_file, body)

    before, report = {(block.id_type, block.name) for block in data_blocks()}, Report()
    steps = list(run(empty_scene, small(tmp_path / "a"), PEOPLE, report, poses=POSES, load=load))
    assert steps[0].news[-1] == "anna: anna.glb holds no person: export it again"
    assert (steps[0].done, steps[0].eta_s) == (VIEWS, None)
    assert [step.done for step in steps[1:5]] == [5, 6, 7, 8]
    assert all(step.total == 2 * VIEWS for step in steps)
    assert steps[1].eta_s > steps[4].eta_s == 0
    assert report.failed == [{"subject": "anna", "what": "capture", "why": "anna.glb holds no person: export it again"}]
    assert report.done == ["bert"]
    assert json.loads((tmp_path / "a/report.json").read_text())["failed"] == report.failed
    assert (tmp_path / "a" / LIST_FILE).read_text().split() == ["bert"]
    assert {(block.id_type, block.name) for block in data_blocks()} == before


def test_shards_share_people_without_gap_or_overlap(empty_scene, tmp_path):
    people = [NamedPerson(name) for name in ("c", "a", "b")]
    poses = POSES.frames([0])
    first = capture(empty_scene, small(tmp_path, shard=(0, 2)), people, poses=poses)
    second = capture(empty_scene, small(tmp_path, shard=(1, 2)), people, poses=poses)
    assert (first.done, second.done) == (["a", "c"], ["b"])
    assert (tmp_path / LIST_FILE).read_text().split() == ["a", "b", "c"]
    assert (tmp_path / "report-0-of-2.json").is_file()
    assert (tmp_path / "report-1-of-2.json").is_file()
    assert not faults(tmp_path)


def test_the_released_codes_reference_is_written_on_request(empty_scene, tmp_path):
    capture(empty_scene, small(tmp_path, released_reference=True), poses=POSES.frames([0]))
    reference = tmp_path / RELEASED_REFERENCE
    assert files_of(reference) == files_of(tmp_path / "anna")
    assert (tmp_path / LIST_FILE).read_text().split() == ["anna", "bert"]
    assert not faults(tmp_path)


@pytest.mark.parametrize("change", [{"seed": 5}, {"samples": 3}, {"light": "dome"}, {"passes": ("img",)}])
def test_a_folder_with_other_captures_is_rejected(copy, empty_scene, change):
    before = files_of(copy)
    with refused(FileError):
        capture(empty_scene, small(copy, **change))
    assert files_of(copy) == before


def test_other_poses_are_rejected_before_anything_is_overwritten(copy, empty_scene):
    (copy / "anna" / COMPLETE_FILE).unlink()
    report = capture(empty_scene, small(copy), poses=POSES.frames([1, 0]))
    assert "other poses" in report.failed[0]["why"]
    assert report.skipped == ["bert"]


def test_poses_that_are_not_finite_are_rejected(empty_scene, tmp_path):
    rotations = POSES.rotations.copy()
    rotations[1, 3] = np.nan
    with refused(ValueError):
        capture(empty_scene, small(tmp_path / "a"), poses=Motion(rotations, POSES.translations, 1.0, "walk.npz"))
    assert not (tmp_path / "a").exists()


def test_fixed_cameras_are_used_for_all_subjects(empty_scene, tmp_path):
    views = Rig(count=2, width=64, height=64).views(np.array([0.0, 0.1, 0.0]), 1.3)
    capture(empty_scene, small(tmp_path, cameras=tuple(views)), poses=POSES.frames([0]))
    for name in ("anna", "bert"):
        cameras = json.loads((tmp_path / name / "cameras.json").read_text())
        assert np.allclose(cameras["camera0001"]["T"], views[1].translation)
    assert not faults(tmp_path)


def test_the_noise_is_the_same_in_whatever_order_views_are_rendered(empty_scene, tmp_path):
    changes = {"light": "dome", "samples": 1}
    capture(empty_scene, small(tmp_path / "both", **changes))
    capture(empty_scene, small(tmp_path / "bert", **changes), PEOPLE[1:])
    for frame, camera in ((0, 0), (1, 1)):
        pictures = [
            picture_path(tmp_path / run / "bert", "img", camera, frame).read_bytes() for run in ("both", "bert")
        ]
        assert pictures[0] == pictures[1]
    seeds = [picture_path(tmp_path / "both" / who, "img", 0, 0).read_bytes() for who in ("anna", "bert")]
    assert seeds[0] != seeds[1]  # the same person under two names: only the noise differs


def test_a_full_disk_ends_the_batch_with_an_error(empty_scene, tmp_path, monkeypatch):
    calls = []

    def full(path, pixels):
        calls.append(path)
        if len(calls) > 5:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write(path, pixels)

    write = passes.write_png
    monkeypatch.setattr(passes, "write_png", full)
    report = Report()
    steps = run(empty_scene, small(tmp_path), PEOPLE, report, poses=POSES, load=load_painted)
    with refused(OSError, "space"):
        list(steps)
    assert [failure["subject"] for failure in report.failed] == ["anna"]
    monkeypatch.undo()
    assert capture(empty_scene, small(tmp_path)).done == ["anna", "bert"]
    assert not faults(tmp_path)


@pytest.mark.slow
def test_memory_stays_flat_over_200_views(empty_scene, tmp_path):
    rig = Rig(count=20, width=256, height=256)
    people = [NamedPerson(f"p{i}") for i in range(6)]
    sizes = [resident_mb() for _ in run(empty_scene, small(tmp_path, rig=rig), people, poses=POSES, load=load_painted)]
    assert len(sizes) >= 240
    assert np.mean(sizes[-10:]) - np.mean(sizes[35:45]) < 30


def resident_mb() -> float:
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


@pytest.mark.parametrize("links", [True, False])
def test_links_where_the_reference_goes_lose_nothing_outside(tmp_path, monkeypatch, links):
    mine = tmp_path / "outside" / "mine"
    mine.parent.mkdir()
    mine.write_text("mine")
    root = tmp_path / "captures"
    (root / "anna").mkdir(parents=True)
    (root / "anna" / "a").write_text("a")
    abandoned = temporary_name(root / RELEASED_REFERENCE)
    abandoned.symlink_to(mine.parent)
    os.utime(abandoned, (0, 0), follow_symlinks=False)
    (root / RELEASED_REFERENCE).symlink_to(mine.parent)
    _name_reference(root, "anna")
    assert (root / RELEASED_REFERENCE / "mine").read_text() == "mine"
    (root / RELEASED_REFERENCE).unlink()
    if not links:
        monkeypatch.setattr(os, "symlink", Mock(side_effect=OSError))
    _name_reference(root, "anna")
    assert (root / RELEASED_REFERENCE / "a").read_text() == "a"
    assert abandoned.is_symlink() == links
    assert mine.read_text() == "mine"
