"""Render Captures as a user and a script press it, on a person in a .glb."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import bpy
import numpy as np
import pytest
from blender_primdiffusion.formats.capture_layout import picture_path
from capture_person import files_of, load_painted
from support.capture_files import faults
from support.errors import refused

import blender_primdiffusion
from blender_primdiffusion.capture.body import read_body
from blender_primdiffusion.capture.command import MARK, main, parse, settings_of
from blender_primdiffusion.capture.stage import data_blocks
from blender_primdiffusion.console import CANCELLED, DONE, FAILED, UNUSABLE
from blender_primdiffusion.jobs.follow import StepRunner
from blender_primdiffusion.scene.armature import build_armature
from blender_primdiffusion.scene.convention import points_to_blender
from blender_primdiffusion.ui import captures_panel
from blender_primdiffusion.ui.captures_panel import captures, command_args

pytestmark = pytest.mark.any_blender

ROOT = Path(__file__).resolve().parents[3]
LAUNCH = ROOT / "blender_primdiffusion" / "capture" / "__main__.py"
SMALL = "--poses 2 --cameras 2 --size 48 48 --samples 2 --device cpu --passes img mask depth"


def write_person(path: Path) -> None:
    """A skinned, textured .glb of the default body with few faces."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    body = read_body()
    armature = build_armature("person", points_to_blender(body.rest(np.zeros(10))[1]))
    bpy.context.scene.collection.objects.link(armature)
    painted = load_painted(bpy.context, None, body)
    painted.pose(np.tile(np.eye(3), (24, 1, 1)), np.zeros(3))
    (obj,) = painted.objects
    obj.parent = armature
    obj.modifiers.new("armature", "ARMATURE").object = armature
    path.parent.mkdir(parents=True)
    bpy.ops.export_scene.gltf(filepath=str(path), export_format="GLB", export_animations=False)


@pytest.fixture(scope="module")
def people(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("people")
    write_person(folder / "person_000000" / "person.glb")
    (folder / "person_000001").mkdir()
    (folder / "person_000001" / "person.glb").write_bytes(b"glTF, but not really")
    return folder


@pytest.fixture(scope="module")
def only_good(people, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("one")
    (folder / "anna.glb").write_bytes((people / "person_000000" / "person.glb").read_bytes())
    return folder


@pytest.fixture
def extension(empty_scene):
    blender_primdiffusion.register()
    yield empty_scene
    blender_primdiffusion.unregister()


@pytest.fixture
def command(empty_scene, capfd):
    """Run the command in this Blender: its exit code, stdout and stderr."""

    def command(*words: object) -> tuple[int, str, str]:
        return (main([str(word) for word in words]), *capfd.readouterr())

    return command


def first_message(child: subprocess.Popen) -> dict:
    """Before it, 5.2 tells where a child has its colours from."""
    assert child.stdout is not None
    line = next(line for line in child.stdout if line.startswith(MARK))
    return json.loads(line[len(MARK) :])


def follow(until=lambda: False, seconds: float = 300) -> None:
    """Tick as Blender's timer does."""
    end = time.monotonic() + seconds
    while captures.busy and not until():
        assert time.monotonic() < end, captures.lines
        captures.tick()
        time.sleep(0.02)


def render(people, out, options: str = SMALL) -> set[str]:
    """Press Render Captures with these folders in the panel."""
    settings = bpy.context.scene.primdiffusion_captures
    settings.people, settings.out, settings.options = str(people), str(out), options
    return bpy.ops.primdiffusion.render_captures()


def start(settings, tmp_path) -> None:
    """As the operator with a window."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    captures.start(captures_panel.capturing(command_args(settings, bpy.context, folder), folder))


def test_the_operator_renders_in_background_mode_and_leaves_the_scene_alone(extension, only_good, tmp_path):
    before = {(block.id_type, block.name) for block in data_blocks()}
    out = tmp_path / "captures"
    assert render(only_good, out) == {"FINISHED"}
    assert {(block.id_type, block.name) for block in data_blocks()} == before
    assert (out / "release_human_list.txt").read_text() == "anna\n"
    assert json.loads((out / "dataset.json").read_text())["frames"] == 2
    assert not faults(out)
    picture_path(out / "anna", "depth", 1, 1).unlink()
    (out / "anna" / "complete.json").unlink()
    assert render(only_good, out) == {"FINISHED"}
    assert not faults(out)


def test_the_operator_reports_an_error_in_one_sentence(extension, people, tmp_path):
    with refused(RuntimeError, "folder"):
        bpy.ops.primdiffusion.render_captures()
    with refused(RuntimeError, "nobody"):
        render(tmp_path / "nobody", tmp_path / "a")
    with refused(RuntimeError, "--size"):
        render(people, tmp_path / "a", "--size big")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").touch()
    with refused(RuntimeError, "empty"):
        render(people, tmp_path / "full")
    with refused(RuntimeError, "pose"):
        render(people, tmp_path / "a", f"{SMALL} --pose-files {tmp_path / 'none.npz'}")


def test_a_batch_continues_past_a_broken_scan_reports_it_and_exits_with_1(command, people, tmp_path):
    out = tmp_path / "captures"
    code, stdout, stderr = command("--people", people, "--out", out, *SMALL.split())
    assert code == FAILED, stdout + stderr
    report = json.loads((out / "report.json").read_text())
    assert report["done"] == ["person_000000"]
    assert [failure["subject"] for failure in report["failed"]] == ["person_000001"]
    assert "person_000001" in stdout
    assert "Fra:" not in stdout
    code, stdout, _ = command("--people", people, "--out", out, *SMALL.split(), "--only", "person_000000")
    assert code == DONE
    assert "1 were there" in stdout
    for shard, name in (("0/2", "person_000000"), ("1/2", "person_000001")):
        assert command("--people", people, "--out", tmp_path / "a", "--list", "--shard", shard)[1].split() == [name]
    assert not (tmp_path / "a").exists()
    assert not faults(out)  # nothing of the broken scan has come into the dataset


def test_a_wrong_command_line_exits_with_2_and_an_error(command, tmp_path):
    for words, message in (
        (["--people", tmp_path], "--out"),
        (["--out", tmp_path, "--cameras", "none"], "--cameras"),
        (["--out", tmp_path / "a", "--people", tmp_path, "--shard", "4/4"], "not a shard"),
    ):
        code, _, stderr = command(*words)
        assert code == UNUSABLE
        assert message in stderr
        assert len(stderr.strip().splitlines()) == 1
    line = [sys.executable, "-m", "blender_primdiffusion.capture", "--people", str(tmp_path)]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=500, cwd=ROOT)
    assert (done.returncode, "--out" in done.stderr) == (UNUSABLE, True)


def test_with_a_window_a_child_renders_and_is_followed(extension, only_good, tmp_path):
    out = tmp_path / "captures"
    asked = extension.scene.primdiffusion_captures
    asked.people, asked.out = str(only_good), str(out)
    asked.pose_count, asked.camera_count, asked.width, asked.height, asked.samples = 2, 2, 48, 48, 2
    start(asked, tmp_path)
    messages = set()
    while captures.busy:
        captures.tick()
        messages.add(captures.message)
        time.sleep(0.02)
    assert captures.error == ""
    assert "anna: view 4 of 4" in messages
    assert (out / "anna" / "complete.json").is_file()
    asked.seed = 3
    start(asked, tmp_path)
    follow()
    assert "seed is 0, not 3" in captures.error


@pytest.mark.parametrize(
    ("message", "fault"),
    [("[1]", "give an object"), ('{"line"', ""), ('{"line": 3}', "line is 3"),
     ('{"subject": "a", "done": -1}', "done is -1"),
     ('{"subject": "a", "done": 1, "total": 2, "eta_s": null, "news": [3]}', "news[0] is 3")],
)  # fmt: skip
def test_a_malformed_message_ends_the_child_with_a_sentence(extension, monkeypatch, tmp_path, message, fault):
    program = f"import time; print({MARK + message!r}, flush=True); time.sleep(600)"
    monkeypatch.setattr(captures_panel, "child_command", lambda: [sys.executable, "-c", program])
    session = StepRunner("", "")
    session.start(captures_panel.capturing([], tmp_path / "folder"))
    end = time.monotonic() + 300
    while session.busy and time.monotonic() < end:
        session.tick()
        time.sleep(0.01)
    assert session.error.startswith("Blender was ended because it sent a malformed message")
    assert fault in session.error


def test_cancelling_ends_the_child_and_the_next_run_resumes(extension, only_good, tmp_path):
    asked = extension.scene.primdiffusion_captures
    asked.people, asked.out = str(only_good), str(tmp_path / "captures")
    asked.pose_count, asked.camera_count, asked.width, asked.height, asked.samples = 2, 3, 200, 200, 8
    start(asked, tmp_path)
    follow(until=lambda: captures.fraction > 0)
    assert bpy.ops.primdiffusion.cancel(what="CAPTURES") == {"FINISHED"}
    follow()
    assert captures.notice.startswith("Cancelled")
    assert captures.error == ""
    done = files_of(tmp_path / "captures")
    start(asked, tmp_path)
    follow()
    assert not captures.error
    after = files_of(tmp_path / "captures")
    assert all(after[name] == done[name] for name in done if name.endswith((".jpg", ".png")))


def test_a_child_whose_parent_is_gone_stops(only_good, tmp_path):
    words = ["--people", str(only_good), "--out", str(tmp_path / "a"), "--progress", "json", "--while-stdin"]
    child = subprocess.Popen(
        [sys.executable, LAUNCH, "--", *words, "--size", "256", "256"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    assert first_message(child)["total"] == 20 * 36
    child.stdin.close()
    assert child.wait(300) == CANCELLED
    child.stdout.close()


def test_a_polite_kill_in_the_midst_of_a_view_ends_the_command_after_it(only_good, tmp_path):
    words = ["--people", str(only_good), "--out", str(tmp_path / "a"), "--progress", "json"]
    child = subprocess.Popen(
        [sys.executable, LAUNCH, "--", *words, "--size", "256", "256"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    first_message(child)
    time.sleep(0.2)
    child.send_signal(signal.SIGTERM)
    _, complaints = child.communicate(timeout=300)
    assert child.returncode == CANCELLED
    assert complaints == ""


def test_the_panels_defaults_are_the_commands(extension, tmp_path):
    asked = extension.scene.primdiffusion_captures
    asked.people, asked.out = str(Path("people").absolute()), str(Path("out").absolute())
    from_panel = settings_of(parse(command_args(asked, extension, tmp_path)))
    from_line = settings_of(parse(["--people", "people", "--out", str(Path("out").absolute())]))
    assert from_panel == from_line
    assert (from_line.camera_count, from_line.pose_count, from_line.size, from_line.samples) == (36, 20, (512, 512), 16)


def test_paths_that_begin_with_a_hyphen_are_no_options(extension, tmp_path):
    asked = extension.scene.primdiffusion_captures
    for people, out in (("-people", str(tmp_path)), (str(tmp_path), "--out")):
        asked.people, asked.out = people, out
        with refused(ValueError, "whole path"):
            command_args(asked, extension, tmp_path)


def test_cameras_of_the_scene_are_taken_by_name(extension, tmp_path):
    scene, asked = extension.scene, extension.scene.primdiffusion_captures
    asked.people = asked.out = str(tmp_path)
    asked.arrangement, asked.width, asked.height = "custom", 80, 60
    with refused(ValueError, "camera"):
        command_args(asked, extension, tmp_path)
    asked.cameras = bpy.data.collections.new("rig")
    scene.collection.children.link(asked.cameras)
    for name, x in (("b", 1.0), ("a", 2.0)):
        camera = bpy.data.objects.new(name, bpy.data.cameras.new(name))
        camera.location, camera.rotation_euler = (x, -4.0, 0.5), (np.pi / 2, 0, 0)
        asked.cameras.objects.link(camera)
    settings = settings_of(parse(command_args(asked, extension, tmp_path)))
    assert [view.position.round(4).tolist() for view in settings.cameras] == [[2, 0.5, 4], [1, 0.5, 4]]
    assert settings.camera_count == 2
    assert (settings.cameras[0].width, settings.cameras[0].height) == (80, 60)
