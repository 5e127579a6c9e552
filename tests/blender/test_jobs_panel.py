"""Pictures of what is being made, errors with their remedies, diagnostics, and memory given back."""

from __future__ import annotations

import errno
import os
import struct
import time
import zlib
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest
from jobs_driven import drive, shown, until_running

from blender_primdiffusion.backend.requests import RequestError, memory_advice
from blender_primdiffusion.jobs import memory, remedies
from blender_primdiffusion.jobs.follow import follow
from blender_primdiffusion.jobs.generate import GenerateJob
from blender_primdiffusion.jobs.pictures import SoFar, so_far
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.scene.human import humans
from blender_primdiffusion.ui import drawing, jobs_panel
from blender_primdiffusion.ui.generate_panel import PRIMDIFFUSION_PT_generate

pytestmark = pytest.mark.any_blender

DIES, FAILS, TAKES_LONG, NO_MEMORY = 1, 2, 4, 106
"""Seeds that the fake child takes as orders."""
ops = bpy.ops.primdiffusion


def write_png(path: Path, colour: tuple[int, int, int], side: int = 8) -> Path:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = (b"\0" + bytes(colour) * side) * side
    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    )
    return path


def started_and_idle() -> int:
    """The process id of a child that has made a person."""
    queue.add(bpy.context, GenerateJob(7, 1))
    drive()
    return queue.child_pid


def ended(pid: int, seconds: float = 3.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        queue.listen()  # as a timer does
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.01)
    return False


def test_pictures_follow_one_another_and_one_at_a_time_is_held(tmp_path):
    picture = SoFar()
    for red in range(0, 200, 40):
        assert picture.show(write_png(tmp_path / f"{red}.png", (red, 0, 0)))
        assert picture._collection["so far"].image_pixels_float[0] == pytest.approx(red / 255, abs=0.01)
        assert len(picture._collection) == 1
    assert not picture.show(picture.shown)
    same = picture.shown
    os.utime(write_png(same, (0, 99, 0)), ns=(1, 1))
    assert picture.show(same), "the same name, written again"
    assert picture._collection["so far"].image_pixels_float[1] == pytest.approx(99 / 255, abs=0.01)
    picture.close()
    picture.close()


def test_a_picture_that_is_gone_or_none_is_no_error(tmp_path):
    picture = SoFar()
    assert not picture.show(None)
    assert not picture.show(tmp_path / "gone.png")
    (tmp_path / "bad.png").write_bytes(b"half a pic")
    picture.show(tmp_path / "bad.png")
    assert (picture.shown, picture.icon) == (None, 0)
    picture.close()


def test_the_childs_picture_is_shown_while_it_works_and_then_no_more(addon):
    queue.add(bpy.context, GenerateJob(TAKES_LONG, 5))
    until_running()
    follow()
    assert so_far.shown.name == "picture.png"
    ops.cancel()
    drive()
    assert so_far.shown is None


def test_each_error_has_a_button_where_there_is_something_to_do(addon):
    expected = {"died": "try_again", "hung": "try_again", "busy": "try_again", "out_of_memory": "release_memory"}
    for kind, operator in expected.items():
        assert remedies.remedy_for(RequestError("", "", kind)).operator == f"primdiffusion.{operator}"
    assert remedies.remedy_for(RequestError("", "", "unwritable")).operator == "wm.save_as_mainfile"
    no_checkpoint = RequestError("there is no checkpoint at 'x.safetensors'", "", "missing_file")
    assert remedies.remedy_for(no_checkpoint).operator == "preferences.addon_show"
    assert remedies.remedy_for(RequestError("there is no folder of captures 'x'", "", "missing_file")) is None
    assert remedies.remedy_for(RequestError("", "", "bad_input")) is None
    environment = remedies.remedy_for(RequestError("", "", "environment"))
    assert environment is None or environment.operator == "primdiffusion.set_up_backend"


def test_the_panel_shows_the_error_its_button_and_the_diagnostics(addon):
    for seed, button in ((DIES, "try_again"), (NO_MEMORY, "release_memory")):
        with pytest.raises(RuntimeError):
            ops.generate(seed=seed, steps=1)
        texts = shown(PRIMDIFFUSION_PT_generate, addon)
        assert f"primdiffusion.{button}" in texts
        assert "primdiffusion.copy_diagnostics" in texts


def test_a_full_disk_is_a_kind_of_its_own(addon):
    full = OSError(errno.ENOSPC, "No space left on device", "x.vdb")
    wrapped = RuntimeError("the volumes cannot be written")
    wrapped.__cause__ = full
    for error in (full, wrapped):
        assert remedies.error_in_the_scene(error).kind == "unwritable"
    assert remedies.error_in_the_scene(ValueError("no")).kind == "scene"
    missing = ValueError("gone")
    missing.kind = "missing_volumes"
    assert remedies.error_in_the_scene(missing).kind == "missing_volumes"


@pytest.mark.parametrize(
    ("params", "advice"),
    [
        ({"views": 8}, "lower Views, or close other programs"),
        ({"seeds": [1, 2], "steps": 3}, "lower Count, or close other programs (fewer Steps would not help)"),
        ({"steps": 3}, "choose a smaller Checkpoint in the preferences (fewer Steps would not help)"),
        ({"voxel": 0.01}, "raise Voxel Size, or close other programs"),
    ],
)
def test_memory_advice_names_settings_that_cost_memory(params, advice):
    assert memory_advice(params) == advice


def test_diagnostics_hold_versions_and_the_error_but_no_folder_or_name(addon, tmp_path, monkeypatch):
    monkeypatch.setenv("USER", "annabel")
    with pytest.raises(RuntimeError):
        ops.generate(seed=FAILS, steps=1)
    told = jobs_panel.diagnostics()
    for part in (bpy.app.version_string, "0-fake", "fake device", "seed 2", "CheckpointError", "checkpoint is damaged"):
        assert part in told
    assert str(tmp_path) not in told
    assert str(Path.home()) not in told
    assert "annabel" not in told
    assert ops.copy_diagnostics() == {"FINISHED"}
    assert bpy.data.texts[jobs_panel.TEXT].as_string().strip() == told.strip()
    ops.copy_diagnostics()
    assert len(bpy.data.texts) == 1


def test_diagnostics_can_be_copied_before_anything_was_done(addon):
    queue.last = None
    assert "not started yet" in jobs_panel.diagnostics()


def test_release_ends_the_child_reports_the_freed_memory_and_the_next_job_starts_another(addon):
    pid = started_and_idle()
    said = memory.release()
    assert said.startswith("1 process ended, 0.")
    assert "GB of memory" in said  # of the process; then what Blender gave back, where tests before left grids
    assert ended(pid)
    assert memory.release() == "nothing to release: the backend is not running"
    assert ops.release_memory() == {"FINISHED"}
    assert started_and_idle() not in (pid, None)
    assert len(humans(bpy.context.scene)) == 2
    assert queue.child_message == ""


def test_memory_is_not_released_while_the_child_is_busy(addon):
    queue.add(bpy.context, GenerateJob(TAKES_LONG, 50))
    until_running()
    with pytest.raises(RuntimeError, match="the backend is busy"):
        ops.release_memory()
    assert queue.busy


def test_an_idle_child_is_ended_after_the_minutes_of_the_preferences(addon, monkeypatch):
    pid = started_and_idle()
    begun = queue.idle_since
    assert memory.idle_minutes() == 10.0
    assert not memory.release_when_idle(begun + 599)
    monkeypatch.setattr(memory, "idle_minutes", lambda: 0.0)
    assert not memory.release_when_idle(begun + 10_000)
    monkeypatch.setattr(memory, "idle_minutes", lambda: 10.0)
    assert memory.release_when_idle(begun + 601)
    assert ended(pid)
    assert not memory.release_when_idle(begun + 700), "nothing is left to end"


@pytest.mark.parametrize("renders", [False, True])
def test_grids_are_given_back_with_an_idle_child_but_not_under_a_render(addon, monkeypatch, renders):
    started_and_idle()
    freed = []
    monkeypatch.setattr("blender_primdiffusion.scene.volumes.free_unused_grids", lambda: freed.append(1))
    monkeypatch.setattr(memory, "idle_minutes", lambda: 10.0)
    monkeypatch.setattr(memory, "bpy", SimpleNamespace(app=SimpleNamespace(is_job_running=lambda _: renders)))
    assert memory.release_when_idle(queue.idle_since + 601)
    assert len(freed) == (0 if renders else 1)


def test_a_busy_child_is_never_idle(addon):
    queue.add(bpy.context, GenerateJob(TAKES_LONG, 50))
    until_running()
    assert not memory.release_when_idle(time.monotonic() + 10_000)


def test_the_device_line_shows_what_is_known(addon):
    assert memory.device_line() == "starts with the first person"
    queue.info = {"device_name": "H200", "device_memory_gb": 139.8, "device_memory_free_gb": 120.04}
    assert memory.device_line() == "H200, 139.8 GB, 120.0 GB free at its start"
    queue.info = {"device_name": "CPU", "device_memory_gb": None, "memory_gb": 16.0, "memory_free_gb": None}
    assert memory.device_line() == "CPU, 16.0 GB"
    queue.info = {"device_name": "CPU"}
    assert memory.device_line() == "CPU"


def test_numbers_keep_their_units_where_lines_break():
    lines = drawing._wrapped("Generated in 47.6 s, and after that built in 2.9 s.")
    assert not any(line.startswith(("s,", "s.")) for line in lines)
    assert " ".join(lines) == "Generated in 47.6 s, and after that built in 2.9 s."
    assert max(map(len, lines)) <= drawing._LINE
