"""The line of works, with the real client and a child that can be told to misbehave."""

from __future__ import annotations

import math
import os
import signal
import time
from pathlib import Path

import bpy
import pytest
from human_files import person_file
from jobs_driven import drive, error_of, notice_of, shown, until_running
from support.errors import refused
from support.fake_child import DIES, FAILS, IGNORES_CANCEL, NO_MEMORY, TAKES_LONG, request_of

from blender_primdiffusion.jobs import follow as follow_module
from blender_primdiffusion.jobs.follow import follow, watch
from blender_primdiffusion.jobs.generate import GenerateJob
from blender_primdiffusion.jobs.queue import error_log, queue
from blender_primdiffusion.scene.human import humans
from blender_primdiffusion.ui.generate_panel import PRIMDIFFUSION_PT_generate
from blender_primdiffusion.ui.jobs_panel import PRIMDIFFUSION_PT_jobs

pytestmark = pytest.mark.any_blender

ops = bpy.ops.primdiffusion


def ask(seed: int, steps: int = 1) -> int:
    return queue.add(bpy.context, GenerateJob(seed, {"steps": steps})).number


def seeds() -> list[int]:
    """Of the people, in the order in which they came."""
    return [request_of(person_file(person))["seed"] for person in humans(bpy.context.scene)]


def test_jobs_run_one_at_a_time_in_the_order_queued(addon):
    for seed in (11, 12, 13):
        ask(seed)
    pids = set()
    while follow() is not None:
        pids.add(queue.child_pid)
        time.sleep(0.01)
    assert seeds() == [11, 12, 13]
    assert len(pids - {None}) == 1
    assert not list(Path(bpy.app.tempdir).glob("generate_*"))


def test_one_that_waits_can_be_taken_out_and_the_others_are_done(addon):
    ask(11, 20)
    second, _ = ask(12), ask(13)
    until_running()
    assert shown(PRIMDIFFUSION_PT_jobs, addon)[:2] == ["Human, seed 11", "primdiffusion.cancel"]
    assert "Human, seed 12" in shown(PRIMDIFFUSION_PT_jobs, addon)
    assert "Queued: 2" in shown(PRIMDIFFUSION_PT_generate, addon)
    assert ops.cancel(number=second) == {"FINISHED"}
    drive()
    assert seeds() == [11, 13]


def test_cancelling_the_running_job_starts_the_next(addon):
    ask(TAKES_LONG, 50)
    ask(12)
    until_running()
    ops.cancel()
    drive()
    assert seeds() == [12]


def test_a_child_that_ignores_cancel_is_ended_and_the_next_job_gets_another(addon):
    ask(IGNORES_CANCEL)
    until_running()
    pid = queue.child_pid
    ops.cancel()
    drive()
    assert notice_of("generate") == "Cancelled"
    assert not list(Path(bpy.app.tempdir).glob("generate_*"))
    ask(12)
    drive()
    assert seeds() == [12]
    assert queue.child_pid != pid
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_failure_does_not_stop_the_line(addon):
    for seed in (DIES, 12, FAILS, 13):
        ask(seed)
    drive()
    assert seeds() == [12, 13]


def test_a_child_that_dies_between_jobs_is_noticed(addon):
    ask(11)
    drive()
    os.kill(queue.child_pid, signal.SIGKILL)
    while not queue.child_message:
        watch()
        time.sleep(0.01)
    assert "killed by the system" in " ".join(shown(PRIMDIFFUSION_PT_generate, addon))
    ask(12)
    drive()
    assert seeds() == [11, 12]
    assert queue.child_message == ""


def test_out_of_memory_is_the_backends_own_sentence(addon):
    with refused(RuntimeError, "memory"):
        ops.generate(seed=NO_MEMORY)


def test_each_result_is_one_undo_step_with_the_name_of_the_job(addon, capfd):
    bpy.ops.ed.undo_push(message="before")
    ask(11)
    ask(12)
    drive()
    bpy.context.window_manager.print_undo_steps()
    steps = [line.partition("name=")[2] for line in capfd.readouterr().out.splitlines() if "name=" in line]
    assert steps[-3:] == ["'before'", "'Generate Human'", "'Generate Human'"]
    bpy.ops.ed.undo()
    assert seeds() == [11]
    bpy.ops.ed.undo()
    assert seeds() == []
    bpy.ops.ed.redo()
    bpy.ops.ed.redo()
    assert seeds() == [11, 12]


def test_a_failed_result_leaves_no_undo_step(addon, capfd):
    bpy.ops.ed.undo_push(message="before")
    with pytest.raises(RuntimeError):
        ops.generate(seed=3)
    bpy.context.window_manager.print_undo_steps()
    assert [line for line in capfd.readouterr().out.splitlines() if "name=" in line][-1].endswith("'before'")


def test_undo_and_redo_during_a_job_are_harmless(addon):
    for name in ("one", "two"):
        bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, None))
        bpy.ops.ed.undo_push(message=name)
    ask(11, 20)
    until_running()
    bpy.ops.ed.undo()
    follow()
    bpy.ops.ed.redo()
    bpy.ops.ed.undo()
    drive()
    assert seeds() == [11]
    assert "two" not in bpy.data.objects


def test_a_result_enters_the_scene_it_was_requested_in_and_the_window_stays(addon):
    first, second = bpy.context.scene, bpy.data.scenes.new("Second")
    window = bpy.context.window_manager.windows[0]
    bpy.ops.ed.undo_push(message="two scenes")
    ask(11, 10)
    until_running()
    window.scene = second
    drive()
    assert (len(humans(first)), len(humans(second))) == (1, 0)
    assert window.scene == second
    bpy.ops.ed.undo()
    assert not [person for scene in bpy.data.scenes for person in humans(scene)]


def test_a_scene_deleted_meanwhile_is_reported_and_nothing_is_added(addon):
    first, second = bpy.context.scene, bpy.data.scenes.new("Second")
    ask(11, 10)
    until_running()
    bpy.context.window_manager.windows[0].scene = second
    bpy.data.scenes.remove(first)
    drive()
    assert "scene 'Scene' was deleted meanwhile" in error_of("generate")
    assert not humans(second)
    assert not bpy.data.volumes


def test_a_result_waits_for_the_user_to_let_go_of_what_is_being_moved(addon, monkeypatch):
    monkeypatch.setattr(follow_module, "blocking_activity", lambda: "Move")
    monkeypatch.setattr("blender_primdiffusion.ui.drawing.blocking_activity", lambda: "Move")
    ask(11)
    while not queue.ready:
        follow()
        time.sleep(0.01)
    for _ in range(5):
        follow()
    assert not humans(bpy.context.scene)
    assert "Done; waiting for Move" in shown(PRIMDIFFUSION_PT_generate, addon)
    assert ops.cancel() == {"FINISHED"}
    drive()
    assert not humans(bpy.context.scene)
    ask(12)
    monkeypatch.setattr(follow_module, "blocking_activity", lambda: "")
    drive()
    assert seeds() == [12]


def test_nothing_is_in_the_way_when_the_user_does_nothing(addon, monkeypatch):
    monkeypatch.setattr("blender_primdiffusion.jobs.windows._last_undo", -math.inf)  # that of a test before
    assert follow_module.blocking_activity() == ""


def test_loading_a_file_ends_the_child_and_drops_all_jobs(addon):
    ask(TAKES_LONG, 50)
    ask(12)
    until_running()
    pid = queue.child_pid
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert not queue.busy
    assert follow() is None
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    assert not humans(bpy.context.scene)


def test_progress_is_shown_once_beside_the_button_and_not_in_the_jobs_panel(addon, monkeypatch):
    monkeypatch.setattr("blender_primdiffusion.ui.drawing._progress_text", lambda: "step 1")
    ask(TAKES_LONG, 50)
    until_running()
    assert "step 1" not in shown(PRIMDIFFUSION_PT_jobs, addon)
    assert shown(PRIMDIFFUSION_PT_generate, addon).count("step 1") == 1
    ops.cancel()
    drive()
    assert shown(PRIMDIFFUSION_PT_jobs, addon) == []


def test_the_panel_shows_the_error_its_button_and_the_log(addon):
    with pytest.raises(RuntimeError):
        ops.generate(seed=NO_MEMORY)
    texts = shown(PRIMDIFFUSION_PT_generate, addon)
    assert "wm.path_open" in texts


def test_the_log_holds_versions_and_the_error(addon):
    with pytest.raises(RuntimeError):
        ops.generate(seed=FAILS)
    text = error_log().read_text(encoding="utf-8")
    for part in (bpy.app.version_string, "0-fake", "fake device", "seed 2", "CheckpointError", "checkpoint is damaged"):
        assert part in text
    assert str(Path.home()) not in text


def test_the_panel_jobs_is_shown_only_while_there_are_any_and_cancel_says_what_is_not_running(addon):
    shows = PRIMDIFFUSION_PT_jobs.poll
    assert not shows(addon)
    with refused(RuntimeError, "running"):
        ops.cancel()
    number = ask(11)
    assert shows(addon)
    refusals = {"number": (number + 1, "queued"), "what": ("CAPTURES", "captures")}
    for name, (value, named) in refusals.items():
        with refused(RuntimeError, named):
            ops.cancel(**{name: value})
    drive()
    assert not shows(addon)
