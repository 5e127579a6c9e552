"""Generate and Cancel as the user meets them, with the real client and a child that can be told to misbehave."""

import os
import signal
import time
from pathlib import Path

import bpy
import pytest
from human_files import person_file
from jobs_driven import drive, error_of, notice_of, shown, until_running
from support.errors import refused
from support.fake_child import TAKES_LONG, request_of

import blender_primdiffusion
from blender_primdiffusion.jobs import generate
from blender_primdiffusion.jobs import queue as queue_module
from blender_primdiffusion.jobs.follow import follow
from blender_primdiffusion.jobs.generate import GenerateJob
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.scene.human import body_of, humans, parts_of
from blender_primdiffusion.ui.generate_panel import PRIMDIFFUSION_PT_generate


def ask(context, seed: int, steps: int) -> None:
    queue.add(context, GenerateJob(seed, {"steps": steps}))


def panel_texts(context) -> list[str]:
    return shown(PRIMDIFFUSION_PT_generate, context)


def test_generate_builds_a_person_and_keeps_the_backends_file(addon):
    addon.scene.primdiffusion.steps = 3
    assert bpy.ops.primdiffusion.generate(seed=7) == {"FINISHED"}
    (person,) = humans(addon.scene)
    assert len(parts_of(person)) == 3
    sent = request_of(person_file(person))
    assert Path(sent.pop("out_dir")).name.startswith("generate_")
    sampling = {"seed": 7, "steps": 3, "sampler": "dpmpp_2m", "guidance": 2.0}
    assert sent == {**sampling, "compact": True, "size": 16, "picture_px": 256}
    assert not queue.busy
    assert error_of("generate") == ""
    assert queue.info["device_name"] == "fake device"


@pytest.mark.any_blender
def test_what_the_human_does_not_show_is_said(addon):
    wanted = addon.scene.primdiffusion.attributes
    wanted.hat = "fedora"
    bpy.ops.primdiffusion.generate(seed=7)
    assert "The human does not show hat." in " ".join(panel_texts(addon))
    wanted.hat, wanted.outfit = "ANY", "suit"
    bpy.ops.primdiffusion.generate(seed=8)
    assert "not show" not in " ".join(panel_texts(addon))


def test_the_view_frames_the_first_human_alone(addon, monkeypatch):
    asked = []
    monkeypatch.setattr(generate, "frame_in_view", lambda: asked.append(len(humans(bpy.context.scene))))
    for seed in (7, 8):
        bpy.ops.primdiffusion.generate(seed=seed)
    assert asked == [1]


@pytest.mark.any_blender
def test_a_killed_child_is_reported(addon):
    ask(addon, TAKES_LONG, 50)
    until_running()
    os.kill(queue.child_pid, signal.SIGKILL)
    drive()
    assert "killed by the system" in error_of("generate")
    assert not humans(addon.scene)


@pytest.mark.any_blender
def test_the_timer_builds_the_person_and_the_panel_shows_progress_then_the_result(addon):
    assert "primdiffusion.generate" in panel_texts(addon)
    ask(addon, TAKES_LONG, 2)
    until_running()
    seen = panel_texts(addon)
    assert "primdiffusion.cancel" in seen
    assert any("step" in text for text in seen)
    bpy.ops.primdiffusion.cancel()
    drive()
    ask(addon, 7, 2)
    drive()
    assert len(humans(addon.scene)) == 1
    assert any("Generated in" in text for text in panel_texts(addon))


@pytest.mark.any_blender
def test_a_cancel_while_the_child_is_importing_ends_the_job_and_keeps_the_child(addon, monkeypatch):
    monkeypatch.setenv("FAKE_ORDER", "imports slowly")
    ask(addon, TAKES_LONG, 50)
    while queue.request is None or queue.request.message != "Loading PyTorch":
        follow()
        time.sleep(0.01)
    follow()  # sends the request
    child = queue.child_pid
    assert bpy.ops.primdiffusion.cancel() == {"FINISHED"}
    drive()
    assert (error_of("generate"), notice_of("generate")) == ("", "Cancelled")
    assert not humans(addon.scene)
    ask(addon, 7, 2)  # waits until the child has dropped the first
    drive()
    assert len(humans(addon.scene)) == 1
    assert queue.child_pid == child


@pytest.mark.any_blender
def test_an_interpreter_that_does_not_exist_is_named(saved_scene, monkeypatch):
    monkeypatch.setattr(queue_module, "preference", lambda name: "/nowhere/python" if name == "backend_python" else "")
    blender_primdiffusion.register()
    try:
        with refused(RuntimeError, "/nowhere/python"):
            bpy.ops.primdiffusion.generate(seed=7)
    finally:
        blender_primdiffusion.unregister()


def test_a_new_human_stands_at_the_cursor_selected(addon):
    addon.scene.cursor.location = (2.0, -1.0, 0.5)
    assert bpy.ops.primdiffusion.generate(seed=7) == {"FINISHED"}
    (person,) = humans(addon.scene)
    armature = person
    body = body_of(person)
    addon.view_layer.update()
    assert tuple(armature.location)[:2] == (2.0, -1.0)
    assert min((armature.matrix_world @ vertex.co).z for vertex in body.data.vertices) == pytest.approx(0.5, abs=1e-5)
    assert addon.view_layer.objects.active == armature
    assert list(addon.view_layer.objects.selected) == [armature]


def test_who_is_being_posed_stays_selected_while_another_human_enters(addon):
    assert bpy.ops.primdiffusion.generate(seed=7) == {"FINISHED"}
    (first,) = humans(addon.scene)
    bpy.ops.object.mode_set(mode="POSE")
    assert bpy.ops.primdiffusion.generate(seed=8) == {"FINISHED"}
    assert addon.view_layer.objects.active == first
    assert addon.mode == "POSE"
    bpy.ops.object.mode_set(mode="OBJECT")
