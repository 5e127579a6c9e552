"""Volumes are written when they are to be seen: by a job for views, before renders by another engine."""

import bpy
import pytest
import synthetic_shape
from human_files import copy_of, folder_of, forget_session_files
from jobs_driven import error_of, notice_of

import blender_primdiffusion
from benchmarks.cycles_preview import setup_cycles_preview
from blender_primdiffusion.engine.engine import ENGINE
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.jobs.volumes import VolumesJob, faults, write_before_rendering
from blender_primdiffusion.scene import volumes
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import HumanTarget, humans
from blender_primdiffusion.scene.representation import in_viewport
from blender_primdiffusion.scene.volume_nodes import are_written, volumes_of

ops = bpy.ops.primdiffusion
COUNT = 12


@pytest.fixture
def person(addon, tmp_path, monkeypatch):
    source = synthetic_shape.write(tmp_path / "human", COUNT)
    monkeypatch.setenv("FAKE_HUMAN", str(source))
    person = build_human(addon, source)
    bpy.ops.ed.undo_push(message="a person")
    return person


def full(*_: object) -> None:
    raise OSError(28, "No space left on device")


@pytest.fixture
def full_disk(monkeypatch):
    monkeypatch.setattr(volumes, "write_vdb", full)
    return monkeypatch


def drawn() -> int:
    bpy.context.view_layer.update()
    return sum(one.object.type == "VOLUME" for one in bpy.context.evaluated_depsgraph_get().object_instances)


def test_shown_in_viewports_they_are_written_and_drawn_and_undo_hides_them(person):
    assert ops.volumes_in_viewport() == {"FINISHED"}
    assert drawn() == COUNT
    assert "3D views show the volumes" in notice_of("volumes")
    bpy.ops.ed.undo()
    assert drawn() == 0
    bpy.ops.ed.redo()
    assert drawn() == COUNT
    assert ops.volumes_in_viewport() == {"FINISHED"}
    assert drawn() == 0


@pytest.mark.any_blender
def test_a_cancelled_job_keeps_what_is_written_and_shows_nothing(person, monkeypatch):
    monkeypatch.setattr("blender_primdiffusion.jobs.volumes.SLICE_S", 1e-3)
    queue.add(bpy.context, VolumesJob(HumanTarget.of(person)))
    queue.tick()
    queue.tick()
    assert queue.advancing
    queue.cancel()
    assert notice_of("volumes") == "Cancelled"
    assert not in_viewport(person)
    assert not list(folder_of(person).glob(".*.partial*"))


@pytest.mark.any_blender
def test_a_full_disk_is_told_and_nothing_is_shown(person, full_disk):
    with pytest.raises(RuntimeError, match="No space left"):
        ops.volumes_in_viewport()
    assert "No space left" in error_of("volumes")
    assert not in_viewport(person)
    assert not list(folder_of(person).glob("*.vdb"))
    full_disk.undo()
    assert ops.volumes_in_viewport() == {"FINISHED"}
    assert drawn() == COUNT


def test_an_edit_shows_its_own_volumes_at_once(person):
    ops.volumes_in_viewport()
    before = folder_of(person)
    assert ops.vary(seed=8) == {"FINISHED"}
    assert folder_of(person) != before
    assert drawn() == COUNT
    bpy.ops.ed.undo()
    assert folder_of(humans(bpy.context.scene)[0]) == before
    assert drawn() == COUNT


def test_a_render_by_another_engine_has_all_volumes(person):
    bpy.context.scene.render.engine = ENGINE
    write_before_rendering(bpy.context.scene)
    assert not are_written(person)
    bpy.context.scene.render.engine = "BLENDER_WORKBENCH"
    write_before_rendering(bpy.context.scene)
    assert are_written(person)


def test_the_first_picture_by_cycles_shows_the_human(person, tmp_path):
    scene = bpy.context.scene
    setup_cycles_preview(scene, size=16)
    scene.render.filepath = str(tmp_path / "picture.png")
    bpy.ops.render.render(write_still=True)
    assert are_written(person)
    picture = bpy.data.images.load(scene.render.filepath)
    assert max(list(picture.pixels)[3::4]) > 0.2


def test_a_copy_renders_what_is_written_for_both(person):
    twin = copy_of(person)
    write_before_rendering(bpy.context.scene)
    assert are_written(twin)
    assert folder_of(twin) == folder_of(person)


@pytest.mark.any_blender
def test_what_a_render_cannot_write_is_told_once(person, full_disk, capsys):
    for _ in range(2):
        write_before_rendering(bpy.context.scene)
    assert "No space left" in faults.text
    full_disk.undo()
    write_before_rendering(bpy.context.scene)
    assert faults.text == ""
    assert are_written(person)


@pytest.mark.any_blender
def test_what_was_wrong_is_forgotten_when_the_extension_is_disabled(person):
    faults.report("the human 'Anna' cannot be drawn")
    blender_primdiffusion.unregister()
    assert faults.text == ""


def test_cycles_merges_humans_that_stand_still_and_leaves_those_that_move(person):
    from blender_primdiffusion.scene.representation import representation_of

    moving = copy_of(person)
    moving.animation_data_create().action = bpy.data.actions.new("Walk")
    assert ops.set_up_engine(engine="CYCLES") == {"FINISHED"}
    assert [representation_of(one) for one in (person, moving)] == ["MERGED", "VOLUMES"]
    bpy.context.scene.render.engine = "BLENDER_WORKBENCH"


def test_volumes_that_an_opened_file_shows_are_hidden_until_they_are_written_again(person):
    ops.volumes_in_viewport()
    bpy.ops.wm.save_mainfile()
    forget_session_files()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    (human,) = humans(bpy.context.scene)
    assert drawn() == 0
    assert not in_viewport(human)
    write_before_rendering(bpy.context.scene)
    volumes_of(human).hide_viewport = False
    assert drawn() == COUNT, "no view has looked for the files before they were there"


@pytest.mark.any_blender
def test_an_edit_on_a_full_disk_is_made_and_its_missing_volumes_are_told(person, monkeypatch):
    ops.volumes_in_viewport()
    before = folder_of(person)
    with monkeypatch.context() as patched:
        patched.setattr(volumes, "write_vdb", full)
        assert ops.vary(seed=8) == {"FINISHED"}
    assert folder_of(person) != before
    assert "No space left" in faults.text
    write_before_rendering(bpy.context.scene)
    assert are_written(person)


def test_volumes_that_renders_hide_are_not_written_and_those_of_other_scenes_are(person):
    volumes_of(person).hide_render = True
    write_before_rendering(bpy.context.scene)
    assert not are_written(person)
    volumes_of(person).hide_render = False
    bpy.ops.scene.new(type="EMPTY")
    write_before_rendering(bpy.context.scene)  # it may hold an instance of the human
    assert are_written(person)
