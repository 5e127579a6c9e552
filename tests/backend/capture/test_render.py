"""People's files to captures on disk: the layout, going on after a kill, failures that stay alone."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from capture_scenes import captured, save_person, small_job
from primdiffusion import cli
from primdiffusion.capture.render import render
from primdiffusion.commands.captures import parse_shard
from primdiffusion.files.regular_files import FileError
from primdiffusion.formats import capture_layout
from support.capture_files import faults
from support.errors import refused

NAMES = ["person_000000", "person_000001"]


def everything(root: Path) -> dict[str, bytes]:
    """All files but zip archives, which hold the time."""
    files = sorted(path for path in root.rglob("*") if path.is_file() and path.suffix not in (".npz", ".json"))
    return {str(path.relative_to(root)): path.read_bytes() for path in files}


def test_captures_have_the_layouts_files_and_are_whole(whole):
    assert (whole / capture_layout.LIST_FILE).read_text().split() == NAMES
    about = capture_layout.read_about(whole)
    assert (about["renderer"], about["light"], about["frames"], about["rig"]["count"]) == (
        "rasteriser",
        "uniform",
        3,
        4,
    )
    for name in NAMES:
        subject = whole / name
        for kind in ("img", "mask", "depth", "normal", "part"):
            pictures = [
                capture_layout.picture_path(subject, kind, camera, frame) for camera in range(4) for frame in range(3)
            ]
            assert all(path.is_file() for path in pictures)
            assert sum(path.is_file() for path in (subject / kind).rglob("*")) == 12
        with np.load(subject / "joints.npz") as joints:
            assert joints["pixel"].shape == (4, 3, 24, 2)
    assert json.loads((whole / "report.json").read_text()) == {"done": NAMES, "failed": [], "skipped": []}


def test_two_workers_make_the_same_files_as_one(whole, tmp_path):
    two = small_job(tmp_path / "two")
    assert sorted(outcome.subject for outcome in render(two, workers=2)) == NAMES
    assert everything(whole) == everything(two.out)


def test_of_an_unfinished_subject_what_is_there_is_kept_and_what_is_missing_is_made(root):
    before = everything(root)
    lost = capture_layout.picture_path(root / NAMES[1], "depth", 2, 1)
    lost.unlink()
    (root / NAMES[1] / capture_layout.COMPLETE_FILE).unlink()
    kept = capture_layout.picture_path(root / NAMES[1], "depth", 2, 2)
    kept_at = kept.stat().st_mtime_ns
    assert {outcome.subject: outcome.status for outcome in render(small_job(root.parent))} == {
        NAMES[0]: "skipped",
        NAMES[1]: "done",
    }
    assert kept.stat().st_mtime_ns == kept_at
    assert everything(root) == before


def test_a_killed_run_is_gone_on_with_and_leaves_the_same_files(tmp_path):
    expected = everything(captured(tmp_path / "expected", frames=6))
    job = small_job(tmp_path, frames=6)
    program = f"""
import sys; sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from pathlib import Path
from capture_scenes import small_job
from primdiffusion.capture.render import render
list(render(small_job(Path({str(tmp_path)!r}), frames=6)))
"""
    child = subprocess.Popen([sys.executable, "-c", program])
    began = time.monotonic()
    while not list(job.out.glob("*/img/*/0003.jpg")):
        assert time.monotonic() - began < 300
        assert child.poll() is None
        time.sleep(0.002)
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    assert not (job.out / NAMES[1] / capture_layout.COMPLETE_FILE).exists()
    assert {outcome.status for outcome in render(job)} <= {"done", "skipped"}
    assert everything(job.out) == expected
    assert not faults(job.out)


@pytest.mark.parametrize("folder", ["img", "outputs_re_fitting", ""])
def test_no_worker_writes_through_a_link_in_the_folder_of_a_human(tmp_path, folder):
    outside, job = tmp_path / "outside", small_job(tmp_path, people=1)
    outside.mkdir()
    capture_layout.claim(job.out, job.about)
    (job.out / NAMES[0] / folder).parent.mkdir(exist_ok=True)
    (job.out / NAMES[0] / folder).symlink_to(outside)
    assert {outcome.subject: outcome.status for outcome in render(job)}[NAMES[0]] == "failed"
    assert not list(outside.iterdir())


def test_a_file_of_poses_that_cannot_be_read_is_named_before_anything_is_rendered(tmp_path, fails):
    save_person(tmp_path / "people" / "p0" / "person.glb")
    np.save(tmp_path / "nan.npy", np.full((3, 72), np.nan))
    line = ["captures", "render", "--people", str(tmp_path / "people"), "--out", str(tmp_path / "out")]
    assert "nan.npy" in fails(*line, "--poses", str(tmp_path / "nan.npy")).err
    assert not (tmp_path / "out").exists()


def test_one_that_fails_leaves_the_others_alone_and_is_reported(tmp_path):
    job = small_job(tmp_path)
    job.people[NAMES[0]].write_bytes(b"glTF but no more")
    outcomes = {outcome.subject: outcome for outcome in render(job)}
    assert (outcomes[NAMES[0]].status, outcomes[NAMES[1]].status) == ("failed", "done")
    report = json.loads((job.out / "report.json").read_text())
    assert report["done"] == [NAMES[1]]
    assert "person.glb" in report["failed"][0]["why"]
    assert (job.out / capture_layout.LIST_FILE).read_text().split() == [NAMES[1]]


def test_another_person_or_pose_in_the_same_folder_is_rejected(tmp_path):
    captured(tmp_path, people=1)
    job = small_job(tmp_path, people=1)
    (job.out / NAMES[0] / capture_layout.COMPLETE_FILE).unlink()
    turned = job.poses.map(lambda values: values.flip(0))
    (outcome,) = render(dataclasses.replace(job, poses=turned))
    assert outcome.status == "failed"
    assert "other poses" in outcome.error


def test_other_settings_in_the_same_folder_are_rejected(tmp_path):
    captured(tmp_path, people=1)
    with refused(FileError, "samples is 9", "not 25"):
        list(render(small_job(tmp_path, people=1, samples=5)))


def test_the_command_renders_a_shard_and_exits_with_1_on_failure(tmp_path, fails):
    for number in range(3):
        save_person(tmp_path / "people" / f"p{number}" / "person.glb")
    line = ["captures", "render", "--people", str(tmp_path / "people"), "--out", str(tmp_path / "out"), "--size", "24",
            "--cameras", "2", "--pose-count", "2", "--released-reference"]  # fmt: skip
    cli.main([*line, "--shard", "0/2"])
    assert sorted(path.parent.name for path in (tmp_path / "out").glob("*/complete.json")) == ["p0", "p2"]
    (tmp_path / "people" / "p1" / "person.glb").write_bytes(b"")
    failed = fails(*line, "--shard", "1/2")
    assert failed.code == 1
    assert "1 of 2 humans failed" in failed.err
    assert (tmp_path / "out" / capture_layout.RELEASED_REFERENCE / "complete.json").exists()
    assert {path.name for path in (tmp_path / "out").glob("report*")} == {"report-0-of-2.json", "report-1-of-2.json"}


@pytest.mark.parametrize("text", ["2/2", "-1/2", "1", "a/b", "0/0", "1/2/3"])
def test_shards_that_are_none_are_rejected(text):
    with refused(ValueError, "shard"):
        parse_shard(text)


@pytest.mark.parametrize(("more", "why"), [({"passes": ("img", "rgba")}, "rgba"), ({"passes": ()}, "passes")])
def test_passes_that_cannot_be_drawn_are_rejected(tmp_path, more, why):
    with refused(ValueError, why):
        list(render(small_job(tmp_path, **more)))
