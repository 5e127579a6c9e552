"""Results that wait to enter the scene, and all that can happen meanwhile; failures; the idle child."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable
from pathlib import Path

import bpy
import pytest
import synthetic_shape
from human_files import folder_of, forget_session_files, paths_of, person_file, remove_human
from jobs_driven import drive, error_of, notice_of, shown, until_ready, until_running
from oracle import evaluated_matrices
from scene_state import state
from support.fake_child import TAKES_LONG, request_of

from blender_primdiffusion.jobs import follow
from blender_primdiffusion.jobs.generate import EditJob, GenerateJob
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import body_of, humans, parts_of
from blender_primdiffusion.scene.volume_nodes import volumes_of
from blender_primdiffusion.ui.advanced_panel import PRIMDIFFUSION_PT_advanced
from blender_primdiffusion.ui.edit_panel import draw_edit
from blender_primdiffusion.ui.generate_panel import PRIMDIFFUSION_PT_generate

pytestmark = pytest.mark.any_blender

ops = bpy.ops.primdiffusion
FINE = 8
"""A seed that is no order to the fake child."""
COUNT = 12
"""Primitives of the synthetic person."""


@pytest.fixture
def person(addon, tmp_path, monkeypatch):
    file = synthetic_shape.write(tmp_path / "prepared", COUNT)
    monkeypatch.setenv("FAKE_HUMAN", str(file))
    person = build_human(addon, file)
    addon.view_layer.objects.active = person
    for name in ("a person", "an empty"):
        bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, None))
        bpy.ops.ed.undo_push(message=name)
    return person


@pytest.fixture
def varied(person):
    """The person, whose edit waits to enter."""
    vary(person)
    until_ready()
    return person


@pytest.fixture
def generated(addon):
    """A human that waits to enter."""
    bpy.ops.ed.undo_push(message="before")
    queue.add(addon, GenerateJob(7, {"steps": 1}))
    until_ready()
    return addon


def vary(person, seed: int = FINE) -> None:
    queue.add(bpy.context, EditJob.of("vary", person, {"steps": 2, "amount": 0.5, "seed": seed}))


def check_whole(person, count: int = COUNT) -> None:
    files = paths_of(person)
    assert len(files) == count
    assert all(path.parent == folder_of(person) for path in files)
    assert len(evaluated_matrices(person)) == count
    assert not list(folder_of(person).glob(".*.partial*"))


def current() -> bpy.types.Object:
    return humans(bpy.context.scene)[0]


def test_a_name_taken_meanwhile_is_left(generated):
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("Human", None))
    drive()
    assert current().name == "Human.001"


def test_another_file_loaded_meanwhile_gets_no_human(generated):
    bpy.ops.wm.read_homefile(use_empty=True)
    drive()
    assert not humans(bpy.context.scene)


def saved_elsewhere(_person, folder: Path) -> None:
    (folder / "film").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "film" / "other.blend"))
    forget_session_files()


MEANWHILE: dict[str, Callable] = {
    "something else is undone": lambda *_: bpy.ops.ed.undo(),
    "the file is saved elsewhere and temporary files go": saved_elsewhere,
    "the human is renamed": lambda person, _: setattr(person, "name", "Anna"),
    "the human is reshaped": lambda person, _: setattr(person.primdiffusion_human, "betas", [1.25] + [0.0] * 9),
    "a script takes the result": lambda *_: ops.apply_result(),
}


@pytest.mark.parametrize("what", MEANWHILE)
def test_an_edit_is_made_whatever_happens_meanwhile(varied, tmp_path, what):
    before = paths_of(varied)
    MEANWHILE[what](varied, tmp_path)
    drive()
    assert error_of("vary") == ""
    assert not set(paths_of(current())) & set(before)
    assert request_of(person_file(current()))["seed"] == FINE
    check_whole(current())
    if "reshaped" in what:
        assert current().primdiffusion_human.betas[0] == pytest.approx(1.25)


@pytest.mark.parametrize("remove", [remove_human, lambda person: bpy.data.batch_remove(list(parts_of(person)))])
def test_a_human_removed_meanwhile_is_reported_and_the_other_is_untouched(person, tmp_path, remove):
    other = build_human(bpy.context, tmp_path / "prepared" / "person.human.safetensors", "Other")
    before = paths_of(other)
    vary(person)
    until_running()
    remove(person)
    drive()
    assert "'Human' was removed during the edit" in error_of("vary")
    assert paths_of(other) == before
    assert not queue.busy


def test_undo_that_makes_the_person_another_meanwhile_rejects_the_result(person):
    vary(person)
    drive()
    vary(person, FINE + 1)
    until_ready()
    bpy.ops.ed.undo()
    before = person_file(current())
    drive()
    assert "changed during the edit" in error_of("vary")
    assert person_file(current()) == before
    bpy.ops.ed.redo()
    check_whole(current())


def test_volumes_deleted_meanwhile_stay_so(varied):
    bpy.data.objects.remove(volumes_of(varied))
    drive()
    assert notice_of("vary").startswith("Varied Human in ")
    assert volumes_of(varied) is None


@pytest.mark.parametrize("part", ["armature", "body", "cube"])
def test_a_result_that_comes_in_edit_mode_leaves_it_and_can_be_undone(person, part):
    cube = bpy.data.objects.new("cube", bpy.data.meshes.new("cube"))
    bpy.context.scene.collection.objects.link(cube)
    body_of(person).hide_viewport = False
    bpy.context.view_layer.objects.active = {"armature": person, "body": body_of(person), "cube": cube}[part]
    bpy.ops.ed.undo_push(message="before")
    before = paths_of(person)
    vary(person)
    bpy.ops.object.mode_set(mode="EDIT")
    drive()
    assert error_of("vary") == ""
    assert bpy.context.mode == "OBJECT"
    assert not set(paths_of(person)) & set(before)
    bpy.ops.ed.undo()
    assert paths_of(current()) == before


def test_cancel_and_a_failure_in_the_scene_leave_the_person_as_they_were(varied, monkeypatch):
    before = person_file(varied)
    ops.cancel()
    drive()
    assert notice_of("vary") == "Cancelled"
    assert person_file(varied) == before
    monkeypatch.setattr("blender_primdiffusion.scene.edit.check_editable", lambda _: 1 / 0)
    vary(varied)
    drive()
    assert error_of("vary")
    assert person_file(current()) == before
    check_whole(current())


WORKS = {
    "generate": (lambda: ops.generate(seed=FINE), PRIMDIFFUSION_PT_generate),
    "vary": (lambda: ops.vary(seed=FINE), draw_edit),
    "merge": (lambda: ops.merge(), PRIMDIFFUSION_PT_advanced),
    "merge_frames": (lambda: ops.merge(what="FRAMES"), PRIMDIFFUSION_PT_advanced),
}
"""What is pressed, and the panel that shows what became of it."""
FAILURES = {
    "dies": "ended by itself",
    "fails": "checkpoint is damaged",
    "gives garbage": "contains no human|is damaged",
}


@pytest.mark.parametrize("order", FAILURES)
@pytest.mark.parametrize("work", WORKS)
def test_a_failure_of_the_child_is_one_sentence_and_leaves_all_as_it_was(person, monkeypatch, work, order):
    monkeypatch.setenv("FAKE_ORDER", order)
    (press, panel), before = WORKS[work], (state(), sorted(folder_of(person).iterdir()))
    with pytest.raises(RuntimeError, match=FAILURES[order]) as caught:
        press()
    assert str(caught.value).count("Error:") == 1
    assert (state(), sorted(folder_of(person).iterdir())) == before
    assert not list(Path(bpy.app.tempdir).glob(f"{work}_*"))
    assert re.search(FAILURES[order], " ".join(shown(panel, bpy.context, opened=True)))


def started_and_idle() -> int:
    """The process id of a child that has made a person."""
    queue.add(bpy.context, GenerateJob(7, {"steps": 1}))
    drive()
    return queue.child_pid


def ended(pid: int, seconds: float = 300.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        queue.listen()  # as a timer does
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.01)
    return False


def test_a_busy_child_is_never_idle(addon):
    queue.add(bpy.context, GenerateJob(TAKES_LONG, {"steps": 50}))
    until_running()
    assert not follow.release_when_idle(time.monotonic() + 10_000)


def test_an_idle_child_is_ended_after_ten_minutes_and_the_next_job_starts_another(addon):
    pid, begun = started_and_idle(), queue.idle_since
    assert not follow.release_when_idle(begun + 599)
    assert follow.release_when_idle(begun + 601)
    assert ended(pid)
    assert not follow.release_when_idle(begun + 700), "nothing is left to end"
    assert started_and_idle() not in (pid, None)
    assert len(humans(bpy.context.scene)) == 2
    assert queue.child_message == ""
