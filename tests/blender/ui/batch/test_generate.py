"""People from the command line: whole, gone on with, named when they fail; by a child that can be told to misbehave."""

from __future__ import annotations

import json
import os
import signal
import threading
from pathlib import Path

import bpy
import numpy as np
import pytest
import synthetic
from human_files import person_file
from support.fake_child import FAILS, TAKES_LONG, request_of

from blender_primdiffusion.backend.environment import BackendNotFound
from blender_primdiffusion.console import CANCELLED, DONE, FAILED, NO_BACKEND, UNUSABLE
from blender_primdiffusion.scene.human import humans
from blender_primdiffusion.ui.batch import execute
from blender_primdiffusion.ui.batch.running import ask

pytestmark = pytest.mark.any_blender


def generate(out: Path, *words: object) -> int:
    return execute(["generate", "--out", str(out), "--steps", "1", "--pictures", "16", *map(str, words)])


def report(out: Path) -> dict:
    return json.loads((out / "report.json").read_text())


def sent(folder: Path) -> dict:
    return request_of(folder / "person.human.safetensors")


@pytest.fixture
def out(addon, tmp_path) -> Path:
    return tmp_path / "Leute in Köln"


def test_all_humans_has_a_folder_named_by_their_seed(out, capfd):
    assert generate(out, "--count", 2, "--seed", 7, "--attributes", "sex=female", "height=1.7") == DONE
    assert sorted(path.name for path in out.iterdir()) == [
        "person_000007",
        "person_000008",
        "report.json",
        "settings.json",
    ]
    asked = sent(out / "person_000008")
    assert (asked["seed"], asked["steps"], asked["size"]) == (8, 1, 16)
    assert (asked["attributes"], asked["guidance"]) == ({"sex": "female", "height": 1.7}, 2.0)
    assert report(out)["done"] == ["person_000007", "person_000008"]
    assert "2/2 person_000008 done" in capfd.readouterr().out


def test_what_a_human_does_not_show_is_printed(out, capfd):
    assert generate(out, "--attributes", "hat=fedora") == DONE
    assert "person_000000: the human does not show hat" in capfd.readouterr().out


def test_the_same_command_continues_and_leaves_what_is_there(out):
    assert generate(out, "--seed", 7) == DONE
    before = (out / "person_000007" / "person.human.safetensors").stat()
    assert generate(out, "--seed", 7, "--count", 2) == DONE
    after = (out / "person_000007" / "person.human.safetensors").stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    assert (report(out)["done"], report(out)["skipped"]) == (["person_000008"], ["person_000007"])


def test_other_settings_are_rejected_without_resume(out, capfd):
    assert generate(out, "--seed", 7) == DONE
    assert generate(out, "--seed", 8, "--sampler", "ddpm") == UNUSABLE
    assert "was made with sampler = ddim, not ddpm" in capfd.readouterr().err
    assert not (out / "person_000008").exists()
    assert generate(out, "--seed", 8, "--sampler", "ddpm", "--resume") == DONE
    assert sent(out / "person_000008")["sampler"] == "ddpm"


def test_one_who_fails_is_named_and_does_not_stop_the_others(out, capfd):
    assert (
        generate(out, "--seed", 1, "--count", 3) == FAILED
    )  # one whose child dies, one whose child refuses, one damaged
    assert generate(out, "--seed", FAILS, "--count", 4, "--resume", "--blend") == FAILED
    failed = report(out)["failed"]
    assert failed[0]["subject"] == "person_000002"
    assert "checkpoint is damaged" in failed[0]["why"]
    assert failed[1]["subject"] == "person_000003"
    assert "person.human.safetensors" in failed[1]["why"]
    assert (out / "person_000003" / "person.human.safetensors").is_file()  # the .blend alone failed
    assert report(out)["done"][-1] == "person_000005"
    assert not list(out.glob(".*"))
    assert "person_000002 failed: " in capfd.readouterr().out


def test_a_blend_holds_the_person_wherever_it_is_moved(out, tmp_path):
    rotations = np.tile(np.eye(3), (3, 24, 1, 1))
    rotations[2, 16] = synthetic.axis_angle(np.array([0.0, 0.0, 0.5]))
    np.save(tmp_path / "wave.npy", rotations)
    assert generate(out, "--seed", 7, "--blend", "--motion", tmp_path / "wave.npy") == DONE
    moved = out.rename(tmp_path / "elsewhere") / "person_000007"
    assert not list(moved.glob("*.blend1"))
    bpy.ops.wm.open_mainfile(filepath=str(moved / "person.blend"))
    scene = bpy.context.scene
    (person,) = humans(scene)
    assert person.name == "person_000007"
    assert person_file(person).read_bytes() == (moved / "person.human.safetensors").read_bytes()
    assert (scene.frame_start, scene.frame_end, scene.render.engine) == (1, 3, "PRIMDIFFUSION")
    bone = person.pose.bones["left_shoulder"]
    scene.frame_set(3)
    assert bone.rotation_quaternion.angle == pytest.approx(0.5, abs=1e-3)


def test_a_blend_requested_later_needs_no_second_generation(out):
    assert generate(out, "--seed", 7) == DONE
    made = (out / "person_000007" / "person.human.safetensors").stat().st_mtime_ns
    assert generate(out, "--seed", 7, "--blend", "anna") == DONE
    folder = out / "person_000007"
    assert (folder / "anna.blend").is_file()
    assert (folder / "person.human.safetensors").stat().st_mtime_ns == made
    assert sorted(path.name for path in folder.iterdir() if path.is_dir()) == []


def test_ctrl_c_ends_the_batch_and_leaves_nothing_half_made(out, capfd):
    threading.Timer(1.5, os.kill, (os.getpid(), signal.SIGINT)).start()
    assert generate(out, "--seed", TAKES_LONG, "--count", 2, "--steps", 50) == CANCELLED
    assert "resumes from here" in capfd.readouterr().out
    assert not list(out.glob("person*"))
    assert not list(out.glob(".*"))
    assert report(out)["done"] == []


def test_without_a_backend_no_human_is_tried(out, monkeypatch, capfd):
    def nowhere(*_, **__):
        raise BackendNotFound("No Python for the backend: /nowhere does not exist")

    monkeypatch.setattr("blender_primdiffusion.backend.environment.search", nowhere)
    assert generate(out, "--count", 3) == NO_BACKEND
    assert "/nowhere does not exist" in capfd.readouterr().err
    assert not out.exists()


def test_people_who_are_there_and_how_they_were_made_stay_without_a_backend(out, monkeypatch):
    assert generate(out, "--seed", 7) == DONE
    before = (out / "settings.json").read_text()
    monkeypatch.setattr("blender_primdiffusion.ui.batch.generate.ask", _no_backend)
    assert generate(out, "--seed", 7, "--count", 2) == NO_BACKEND
    assert (out / "settings.json").read_text() == before
    assert report(out)["skipped"] == ["person_000007"]


def test_a_lost_backend_leaves_the_finished_humans_and_names_them(out, monkeypatch):
    def lost(backend, method, params, *more):
        return _no_backend() if params["seed"] == 8 else ask(backend, method, params, *more)

    monkeypatch.setattr("blender_primdiffusion.ui.batch.generate.ask", lost)
    assert generate(out, "--seed", 7, "--count", 3) == NO_BACKEND
    assert report(out)["done"] == ["person_000007"]
    assert (out / "settings.json").is_file()
    assert (out / "person_000007").is_dir()


def _no_backend(*_, **__):
    raise BackendNotFound("No Python for the backend")


def test_a_folder_that_cannot_be_is_a_sentence(addon, tmp_path, capfd):
    (tmp_path / "file").write_text("")
    assert generate(tmp_path / "file" / "people") == UNUSABLE
    errors = capfd.readouterr().err
    assert f"nothing can be written to {tmp_path / 'file' / 'people'} (" in errors
    assert "choose another folder with --out" in errors


def test_nothing_is_written_through_a_link_in_the_folder(out, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    out.mkdir()
    (out / "person_000007").symlink_to(tmp_path / "elsewhere")
    assert generate(out, "--count", 2, "--seed", 7) == FAILED
    assert not list((tmp_path / "elsewhere").iterdir())
    assert report(out)["done"] == ["person_000008"]
    assert "person_000007 is a link" in report(out)["failed"][0]["why"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--count", "0"], "invalid whole number from 1 value: '0'"),
        (["--count", "2", "--seed", str(2**63 - 1)], f"seed is {2**63}"),
        (["--attributes", "tall"], "'tall' is not name=value"),
        (["--sampler", "euler"], "invalid choice: 'euler'"),
        (["--checkpoint", "/nowhere.safetensors"], "--checkpoint /nowhere.safetensors is no file"),
        (["--motion", "/nowhere.bvh", "--blend"], "--motion /nowhere.bvh is no file"),
        (["--blend", "../away.blend"], "is no file name"),
        (["--blend", "--no-blend"], "not allowed with"),
    ],
)
def test_wrong_options_are_named_before_anything_is_written(out, words, sentence, capfd):
    assert generate(out, *words) == UNUSABLE
    assert sentence in capfd.readouterr().err
    assert not list(out.glob("person*"))


def test_a_pose_without_a_blend_is_rejected(out, tmp_path, capfd):
    np.save(tmp_path / "pose.npy", np.zeros(72))
    assert generate(out, "--pose", tmp_path / "pose.npy") == UNUSABLE
    assert "add --blend" in capfd.readouterr().err


@pytest.mark.parametrize("command", ["generate", "render", "capture"])
def test_help_is_there_and_no_failure(addon, command, capfd):
    try:
        code = execute([command, "--help"])
    except SystemExit as left:
        code = left.code
    assert code == DONE
    assert "usage:" in capfd.readouterr().out


def test_without_a_command_those_there_are_are_named(addon, capfd):
    assert execute([]) == UNUSABLE
    assert "generate --count" in capfd.readouterr().err
    assert execute(["--help"]) == DONE
