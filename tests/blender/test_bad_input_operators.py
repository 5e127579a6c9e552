"""Everything a user can press in a wrong order: each operator works, or says in one sentence what is wrong."""

import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import bpy
import pytest
import synthetic_shape
from blend_tampering import panels_fault
from human_files import lose_data
from jobs_driven import drive
from scene_state import state
from shown_words import ways

from blender_primdiffusion.jobs.generate import EditJob, GenerateJob
from blender_primdiffusion.jobs.parts import complete
from blender_primdiffusion.jobs.queue import Job, queue
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.handles import add_handles
from blender_primdiffusion.scene.human import body_of, humans

ELSEWHERE = {"set_up_backend"}
"""Whatever is in the scene, it stays as it is."""


def operators() -> list[tuple[str, dict[str, object]]]:
    """Every operator, in each of its ways."""
    return [(name, given) for name in dir(bpy.ops.primdiffusion) for given in ways(name)]


def fault(name: str, properties: dict[str, object]) -> str:
    """What is wrong about the operator's answer; empty when nothing is."""
    before = state()
    try:
        answer = getattr(bpy.ops.primdiffusion, name)(**properties)
    except RuntimeError as error:
        text = str(error).strip()
        if "Traceback" in text:
            return f"{name}: {text.splitlines()[-1]}\n{text}"
        if "context is incorrect" in text:
            return f"{name}: poll without a reason"
        message = re.sub(r"^(Error: |Operator bpy\.ops\.primdiffusion\.\w+\.poll\(\) )", "", text)
        if "\n" in message or len(message.split()) < 3:
            return f"{name}: no sentence: {message!r}"
        changes = [(a, b) for a, b in zip(before, state(), strict=True) if a != b]
        return f"{name}: rejected ({message}) after changing {changes}" if changes else ""
    if answer not in ({"FINISHED"}, {"PASS_THROUGH"}):  # the latter leaves a click to Blender
        return f"{name}: {answer} without a word"
    changes = [(a, b) for a, b in zip(before, state(), strict=True) if a != b] if name in ELSEWHERE else []
    return f"{name}: changed {changes}" if changes else ""


def empty(_person) -> None:
    bpy.data.batch_remove([*bpy.data.objects, *bpy.data.collections])


def nothing_active(_person) -> None:
    bpy.context.view_layer.objects.active = None
    for obj in bpy.context.view_layer.objects:
        obj.select_set(False)


def _enter(obj: bpy.types.Object, mode: str) -> None:
    obj.hide_viewport = False
    bpy.context.view_layer.objects.active = obj
    bpy.ops.object.mode_set(mode=mode)


def mark_damaged(person) -> None:
    person["primdiffusion_human"] = "{}"


def linked(_person) -> None:
    path = bpy.data.filepath
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(path, link=True) as (_, wanted):
        wanted.collections = ["Anna"]
    bpy.context.scene.collection.children.link(wanted.collections[0])


def overridden(person) -> None:
    linked(person)
    made = bpy.data.collections["Anna"].override_hierarchy_create(bpy.context.scene, bpy.context.view_layer)
    assert made is not None


def instanced(person) -> None:
    linked(person)
    bpy.context.scene.collection.children.unlink(bpy.data.collections["Anna"])
    empty = bpy.data.objects.new("Anna here", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", bpy.data.collections["Anna"]
    bpy.context.scene.collection.objects.link(empty)
    bpy.context.view_layer.objects.active = empty


def hidden(person) -> None:
    bpy.context.view_layer.layer_collection.children[person.name].hide_viewport = True
    bpy.data.collections[person.name].hide_viewport = True


def never_saved(person) -> None:
    bpy.ops.wm.read_homefile(use_empty=True)
    build_human(bpy.context, SOURCE["file"], "Anna")


def backend_missing(_person) -> None:
    from blender_primdiffusion.backend import environment
    from blender_primdiffusion.backend.environment import BackendNotFound

    def nowhere(*_, **__):
        raise BackendNotFound("the preferences name the Python '/nowhere/python', which does not exist: set it up")

    environment.find_python = nowhere


def two_people(_person) -> None:
    build_human(bpy.context, SOURCE["file"], "Berta")
    nothing_active(None)


def tiny_units(person) -> None:
    bpy.context.scene.unit_settings.scale_length = 0.01
    person.scale = (100, 100, 100)


SITUATIONS: dict[str, Callable] = {
    **{one.__name__: one for one in (empty, nothing_active, mark_damaged, linked, overridden, instanced, hidden)},
    **{one.__name__: one for one in (never_saved, backend_missing, two_people, tiny_units)},
    "armature_in_edit_mode": lambda person: _enter(person, "EDIT"),
    "armature_in_pose_mode": lambda person: _enter(person, "POSE"),
    "body_in_edit_mode": lambda person: _enter(body_of(person), "EDIT"),
    "body_being_painted": lambda person: _enter(body_of(person), "WEIGHT_PAINT"),
    "armature_deleted": lambda person: bpy.data.objects.remove(person),
    "armature_data_deleted": lambda person: bpy.data.armatures.remove(person.data),
    "volumes_deleted": lambda _: bpy.data.batch_remove(list(bpy.data.volumes)),
    "body_deleted": lambda person: bpy.data.objects.remove(body_of(person)),
    "bones_renamed": lambda person: setattr(person.data.bones["spine2"], "name", "Wirbelsäule"),
    "excluded": lambda person: setattr(bpy.context.view_layer.layer_collection.children[person.name], "exclude", True),
    "data_missing": lose_data,
    "with_ik_handles": lambda person: add_handles(bpy.context, person),
}
SOURCE: dict[str, Path] = {}


@pytest.fixture
def anna(addon, tmp_path, monkeypatch):
    from blender_primdiffusion.backend import environment

    monkeypatch.setattr(environment, "find_python", environment.find_python)  # after `backend_missing`
    SOURCE.update(file=synthetic_shape.write(tmp_path / "human", 8))
    monkeypatch.setenv("FAKE_HUMAN", str(SOURCE["file"]))
    person = build_human(addon, SOURCE["file"], "Anna")
    bpy.context.view_layer.objects.active = person
    bpy.context.scene.frame_end = 2
    bpy.ops.wm.save_mainfile()
    (tmp_path / "for the child").mkdir()
    yield tmp_path
    shutil.rmtree(tmp_path / "for the child")  # threads wait there for the child's files


@pytest.fixture
def outside(anna, monkeypatch):
    """Nothing is downloaded or installed."""
    from blender_primdiffusion.jobs.follow import StepRunner

    def start(session: StepRunner, _steps: object) -> None:
        session.notice = "as if it were done"

    monkeypatch.setattr(StepRunner, "start", start)
    monkeypatch.setattr("blender_primdiffusion.backend.environment.short_root", lambda *_: anna / "set up")
    bpy.context.preferences.system.use_online_access = True
    yield
    bpy.context.preferences.system.use_online_access = False


def _asked(monkeypatch, folder: Path) -> None:
    """Works are asked for their parameters, and then end well: what the child does is for other tests."""
    from blender_primdiffusion.jobs import follow
    from blender_primdiffusion.jobs.queue import JobOutcome, error_in_the_scene, queue

    def wait_for(entry):
        queue.waiting.remove(entry)
        try:
            entry.job.params(folder)
        except (ValueError, OSError) as error:
            return JobOutcome(entry, error=error_in_the_scene(error))
        return JobOutcome(entry, "done")

    monkeypatch.setattr(follow, "_wait_for", wait_for)


@pytest.mark.parametrize("situation", SITUATIONS)
@pytest.mark.usefixtures("outside")
def test_every_operator_works_or_reports_what_is_wrong(anna, situation, monkeypatch):
    if situation != "backend_missing":
        _asked(monkeypatch, anna / "for the child")
    faults = []
    again = True
    for name, properties in operators():
        if again:
            bpy.ops.wm.open_mainfile(filepath=str(anna / "shot.blend"))
            SITUATIONS[situation](humans(bpy.context.scene)[0])
            complete()  # operators do it first
        before = state()
        wrong = fault(name, properties)
        again = before != state()
        if wrong:
            faults.append(f"{properties} {wrong}")
    assert not faults, "\n".join(faults)


JOBS: dict[str, Callable[[bpy.types.Object], Job]] = {
    "generated": lambda _: GenerateJob(11, {"steps": 1}),
    "varied": lambda person: EditJob.of("vary", person, {"steps": 1, "amount": 0.5, "seed": 3}),
}


@pytest.mark.any_blender
@pytest.mark.parametrize("ask", JOBS)
@pytest.mark.parametrize("situation", SITUATIONS)
def test_a_waiting_result_enters_the_scene_or_reports_why_not(anna, situation, ask, capfd):
    (person,) = humans(bpy.context.scene)
    queue.add(bpy.context, JOBS[ask](person))
    while not queue.ready:
        queue.tick()
        assert queue.busy, queue.last.sentence
        time.sleep(0.01)
    SITUATIONS[situation](person)
    if not queue.ready:  # the file was closed
        assert not queue.busy
        return
    before = state()
    drive()
    assert "Traceback" not in capfd.readouterr().err
    error = queue.last.error
    if error is not None:
        assert error.kind != "died"
        assert len(str(error).split()) > 3
        assert "\n" not in str(error)
        after = state()
        assert (after[0], *after[2:]) == (before[0], *before[2:]), str(error)


@pytest.mark.parametrize("situation", SITUATIONS)
def test_every_panel_draws(anna, situation):
    SITUATIONS[situation](humans(bpy.context.scene)[0])
    assert panels_fault() == ""
