"""The engine and its child: progress, cancelling, deaths and missing backends, with a child that misbehaves at will."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from backend_python import use_this_python
from engine_stage import pixels, set_up_render
from support.errors import refused
from support.fake_child import FAKE_CHILD

import blender_primdiffusion
from blender_primdiffusion.engine import drawing_child
from blender_primdiffusion.engine.drawing_child import SharedFrames, frames
from blender_primdiffusion.engine.engine import render_layer

pytestmark = pytest.mark.any_blender

SIZE = (40, 32)
COLOUR = np.round(255 * np.array([0.5372549, 0.7372549, 0.88235295, 1.0]))
"""(.25, .5, .75) as sRGB: what the fake child fills frames with."""


@pytest.fixture
def stage(saved_scene, tmp_path, monkeypatch):
    """The engine on the fake child, with a camera."""
    use_this_python(monkeypatch, FAKE_CHILD)
    blender_primdiffusion.register()
    scene = saved_scene.scene
    set_up_render(scene, SIZE, (0, 0, 0), (0, 0, 0))
    scene.render.film_transparent = False
    scene.render.filepath = str(tmp_path / "picture.png")
    yield SimpleNamespace(scene=scene, out=tmp_path / "picture.png")
    blender_primdiffusion.unregister()


class Engine:
    """Stands in for Blender's side of a render: records messages and progress, and stops when asked to."""

    camera_override = None
    resolution_x, resolution_y = SIZE

    def __init__(self, stop_after_s: float = 1e9):
        self.stats, self.progress, self.ended = [], [], []
        self._stop_at = time.monotonic() + stop_after_s

    def begin_result(self, *_: object, **__: object) -> SimpleNamespace:
        return SimpleNamespace(layers=[SimpleNamespace(passes=[])])

    def end_result(self, _result: object, **how: bool) -> None:
        self.ended.append(how)

    def update_stats(self, _: str, text: str) -> None:
        self.stats.append(text)

    def update_progress(self, fraction: float) -> None:
        self.progress.append(fraction)

    def test_break(self) -> bool:
        return time.monotonic() > self._stop_at


def render() -> set[str]:
    return bpy.ops.render.render(write_still=True)


def test_the_frame_reaches_the_picture(stage):
    assert render() == {"FINISHED"}
    assert np.abs(255 * pixels(stage.out) - COLOUR).max() <= 1


def test_a_second_picture_uses_the_same_child_and_the_same_file(stage):
    render()
    pid, files = drawing_child.child_pid(), sorted(frames.folder.iterdir())
    render()
    assert drawing_child.child_pid() == pid
    assert sorted(frames.folder.iterdir()) == files


def test_progress_and_seconds_left_are_reported_band_by_band(stage, monkeypatch):
    monkeypatch.setenv("FAKE_STEP_S", "0.15")
    engine = Engine()
    drawing = render_layer(engine, bpy.context.evaluated_depsgraph_get())
    assert drawing.state == "done"
    assert engine.progress[-1] >= 0.75
    assert engine.progress == sorted(engine.progress)
    assert any("of 32, 1.0 s left" in text for text in engine.stats)
    assert engine.ended == [{"cancel": False, "do_merge_results": True}]


def test_a_cancel_ends_the_picture_within_a_band(stage, monkeypatch):
    monkeypatch.setenv("FAKE_STEP_S", "0.3")
    render()
    engine = Engine(stop_after_s=0.1)
    drawing = render_layer(engine, bpy.context.evaluated_depsgraph_get())
    assert drawing.state == "cancelled"
    assert max(engine.progress, default=0.0) < 1.0


def test_a_picture_that_a_defect_interrupted_does_not_block_the_next(stage):
    class Broken(Engine):
        def update_progress(self, fraction: float) -> None:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        render_layer(Broken(), bpy.context.evaluated_depsgraph_get())
    assert render() == {"FINISHED"}


def test_closing_the_child_ends_a_picture_at_once(stage, monkeypatch):
    monkeypatch.setenv("FAKE_STEP_S", "5")

    class Closing(Engine):
        def update_stats(self, _: str, text: str) -> None:
            drawing_child.close()

    began = time.monotonic()
    assert render_layer(Closing(), bpy.context.evaluated_depsgraph_get()).state == "cancelled"
    assert time.monotonic() - began < drawing_child.CANCEL_PATIENCE_S / 2


def test_a_child_that_dies_is_one_error_and_the_next_render_works(stage, monkeypatch):
    monkeypatch.setenv("FAKE_ORDER", "dies")
    with refused(RuntimeError, "Try again, with other programs closed") as caught:
        render()
    assert str(caught.value).count("Error:") == 1
    assert not stage.out.exists()
    monkeypatch.delenv("FAKE_ORDER")
    assert render() == {"FINISHED"}


def test_a_child_killed_between_pictures_is_replaced_silently(stage):
    render()
    pid = drawing_child.child_pid()
    os.kill(pid, signal.SIGKILL)
    time.sleep(0.2)
    assert render() == {"FINISHED"}
    assert drawing_child.child_pid() != pid


def test_an_error_of_the_child_keeps_its_remedy_and_ends_an_animation(stage, monkeypatch, tmp_path):
    monkeypatch.setenv("FAKE_ORDER", "fails")
    stage.scene.frame_end = 3
    stage.scene.render.filepath = str(tmp_path / "frame_")
    with refused(RuntimeError, "checkpoint"):
        bpy.ops.render.render(animation=True)
    assert not list(tmp_path.glob("frame_*"))


def test_without_a_backend_the_error_says_what_to_do(stage, monkeypatch):
    monkeypatch.setattr("blender_primdiffusion.backend.environment.find_python", find_nothing)
    with refused(RuntimeError, "preferences"):
        render()


def find_nothing(*_: object) -> None:
    from blender_primdiffusion.backend.environment import BackendNotFound

    raise BackendNotFound("No Python for the backend; name one in the extension's preferences.")


@pytest.mark.parametrize("kind", ["PANO", "LIGHT"])
def test_an_unsupported_camera_is_one_clear_error(stage, kind):
    if kind == "PANO":
        stage.scene.camera.data.type = "PANO"
    else:
        stage.scene.camera = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "SPOT"))
        stage.scene.collection.objects.link(stage.scene.camera)
    with refused(RuntimeError, kind.lower()):
        render()


def test_a_camera_that_shows_nothing_is_one_clear_error(stage):
    camera = stage.scene.camera
    camera.data.clip_start, camera.data.clip_end = 5.0, 1.0
    with refused(RuntimeError, "5 m", "1 m"):
        render()
    camera.data.clip_end, camera.scale = 100.0, (0, 0, 0)
    with refused(RuntimeError, "scaled"):
        render()


def test_blender_itself_rejects_a_picture_without_camera_or_pixels_and_the_next_one_works(stage):
    camera, settings = stage.scene.camera, stage.scene.render
    stage.scene.camera = None
    with refused(RuntimeError, "camera"):
        render()
    stage.scene.camera, settings.use_border = camera, True
    for edges in ((0.5, 0.5), (0.5, 0.501), (0.7, 0.3)):
        settings.border_min_x, settings.border_max_x = edges
        with refused(RuntimeError, "small"):
            render()
    settings.use_border, settings.resolution_percentage = False, 1
    with refused(RuntimeError, "small"):
        render()
    settings.resolution_percentage = 100
    assert render() == {"FINISHED"}


def test_unregistering_ends_the_child_removes_the_frames_and_leaves_the_scene_a_usable_engine(stage):
    render()
    folder, pid = frames.folder, drawing_child.child_pid()
    blender_primdiffusion.unregister()
    try:
        assert not folder.exists()
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
        assert stage.scene.render.engine.startswith("BLENDER_EEVEE")
    finally:
        blender_primdiffusion.register()


def test_an_idle_child_ends_by_itself_and_the_next_picture_starts_another(stage):
    render()
    pid = drawing_child.child_pid()
    end = time.monotonic() + 300
    while drawing_child.child_pid() is not None and time.monotonic() < end:
        drawing_child.end_when_idle(0.3)  # a timer does
        time.sleep(0.05)
    assert drawing_child.child_pid() is None
    assert render() == {"FINISHED"}
    assert drawing_child.child_pid() not in (None, pid)


EXIT_WHILE_DRAWING = """
import sys, os, time
from pathlib import Path
import bpy, blender_primdiffusion as b, pytest
sys.path.insert(0, "tests/blender")
from backend_python import use_this_python
use_this_python(pytest.MonkeyPatch(), Path(sys.argv[1]))
b.register()
from blender_primdiffusion.engine import drawing_child
from blender_primdiffusion.engine.drawing_child import frames
frame = frames.take(8, 8)
request = drawing_child.draw({"frame": str(frame.path), "region": None, "width": 8, "height": 8})
while request.step == 0:
    request.tick()
    time.sleep(0.01)
print(drawing_child.child_pid(), frames.folder, flush=True)
if sys.argv[2] == "killed":
    os.kill(os.getpid(), 9)
"""


@pytest.mark.parametrize("how", ["quit", "killed"])
def test_ending_blender_during_a_picture_leaves_no_process(how):
    command = [sys.executable, "-c", EXIT_WHILE_DRAWING, str(FAKE_CHILD), how]
    root, environment = Path(__file__).parents[3], {**os.environ, "FAKE_STEP_S": "1.0"}
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, timeout=500, check=False)
    pid, folder = done.stdout.strip().splitlines()[-1].split()
    end = time.monotonic() + 300
    while Path(f"/proc/{pid}").exists() and time.monotonic() < end:
        time.sleep(0.05)
    assert not Path(f"/proc/{pid}").exists()
    if how == "quit":
        assert not Path(folder).exists()
    else:
        shutil.rmtree(Path(folder).parent)  # as all of a killed Blender's temporary files


def test_a_full_disk_is_an_error_that_leaves_no_file(monkeypatch):
    def fallocate(_descriptor: int, _start: int, _size: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", fallocate)
    frames = SharedFrames()
    with refused(OSError, "No space"):
        frames.take(8, 4)
    assert not list(frames.folder.iterdir())
    frames.close()
