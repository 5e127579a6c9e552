"""Volumes written after their human stands, and all that can happen before, during and after."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import bpy
import pytest
import synthetic_shape
from jobs_driven import drive

import blender_primdiffusion
from blender_primdiffusion.jobs import late_volumes as module
from blender_primdiffusion.jobs.generate import GenerateJob
from blender_primdiffusion.jobs.late_volumes import late_volumes
from blender_primdiffusion.jobs.missing_files import look, state
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.scene import attachment, unwritten
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.collect import unused
from blender_primdiffusion.scene.cycles import setup_cycles_preview
from blender_primdiffusion.scene.duplicate import duplicate_human
from blender_primdiffusion.scene.human import (
    armature_of,
    folder_of,
    folders_of,
    humans,
    humans_folder,
    person_file,
    unwritten_in,
    volume_path,
    volumes_of,
)
from blender_primdiffusion.scene.unwritten import write_all_unwritten, write_unwritten
from blender_primdiffusion.scene.volumes import person_memory

COUNT = 12
"""Primitives of the synthetic person."""
ops = bpy.ops.primdiffusion


@pytest.fixture
def hidden(addon, tmp_path, monkeypatch):
    """Volumes are written as with a window."""
    monkeypatch.setattr("blender_primdiffusion.jobs.queue.volumes_may_wait", lambda: True)
    monkeypatch.setattr(
        "blender_primdiffusion.scene.edit.volumes_may_wait", lambda person: not attachment.in_viewport(person)
    )
    monkeypatch.setenv("FAKE_HUMAN", str(synthetic_shape.write(tmp_path / "prepared.npz", COUNT)))
    return addon


@pytest.fixture
def person(hidden):
    """A human who stands, without a volume on disk."""
    bpy.ops.ed.undo_push(message="before")
    return generated()


STATES = ("unwritten", "half", "written")


@pytest.fixture(params=STATES)
def in_each_state(person, request):
    advance(request.param)
    return person


def generated(seed: int = 7) -> bpy.types.Collection:
    queue.add(bpy.context, GenerateJob(seed, 1))
    drive()
    return humans(bpy.context.scene)[-1]


def advance(state_wanted: str) -> None:
    """Write no volumes, about half of them, or all."""
    if state_wanted == "half":
        while len(on_disk()) < COUNT // 2:
            assert late_volumes.work(0.0)
    elif state_wanted == "written":
        while late_volumes.work(0.0):
            pass


def on_disk(root: Path | None = None) -> list[Path]:
    return sorted((root or humans_folder()).rglob("prim_*.vdb"))


def paths_of(person: bpy.types.Collection) -> list[Path]:
    return [volume_path(obj.data) for objects in volumes_of(person).values() for obj in objects]


def check_complete(person: bpy.types.Collection) -> None:
    """Every volume of the human has its file, and nothing is left to write."""
    paths = paths_of(person)
    assert len(paths) == COUNT
    assert all(path.is_file() for path in paths)
    assert not unwritten_in(paths[0].parent)
    assert not list(paths[0].parent.glob(".*.partial*"))


def test_the_human_stands_before_any_volume_is_written(person):
    assert not on_disk()
    assert len(unwritten_in(folder_of(person))) == 1
    assert len(volumes_of(person)) == COUNT
    assert person_file(person).is_file()
    assert armature_of(person).visible_get()
    look()
    assert state.summary == "", "what is not yet written is not missing"


def test_the_files_written_later_are_those_that_would_be_written_at_once(person, tmp_path):
    write_all_unwritten()
    check_complete(person)
    at_once = build_human(bpy.context, tmp_path / "prepared.npz", "Anna")
    later = {path.name: path for path in paths_of(person)}
    for path in paths_of(at_once):
        assert later[path.name].stat().st_size == path.stat().st_size


def test_hidden_volumes_cost_the_viewport_nothing_and_renders_have_them(person):
    graph = bpy.context.evaluated_depsgraph_get()
    assert not [instance for instance in graph.object_instances if instance.object.type == "VOLUME"]
    assert not any(isinstance(block, bpy.types.Volume) for block in graph.ids)
    primitives = next(child for child in person.children if child.name.endswith("_primitives"))
    assert primitives.hide_viewport
    assert not primitives.hide_render
    assert armature_of(person).name in primitives.objects


def test_a_slice_is_as_long_as_the_drawing_before_it_within_limits(person, monkeypatch):
    given, now = [], [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(late_volumes, "work", lambda seconds: given.append(round(seconds, 3)) or True)
    for drawing in (0.0, 0.1, 3.0):
        late_volumes._ended = now[0]
        now[0] += module.PAUSE_S + drawing
        assert late_volumes.tick() == module.PAUSE_S
    assert given == [module.SHORTEST_S, 0.1, module.LONGEST_S]


def test_the_timer_waits_for_what_the_user_holds_and_ends_with_the_work(person, monkeypatch):
    monkeypatch.setattr(module, "in_the_way", lambda: "Move")
    assert late_volumes.tick() == module.BLOCKED_S
    assert not on_disk()
    monkeypatch.undo()
    while late_volumes.tick() is not None:
        pass
    check_complete(person)


def test_a_render_by_another_engine_has_all_volumes(in_each_state):
    module.write_before_rendering(bpy.context.scene)
    check_complete(in_each_state)


def test_a_render_by_the_own_engine_writes_nothing(person):
    bpy.context.scene.render.engine = "PRIMDIFFUSION"
    module.write_before_rendering(bpy.context.scene)
    bpy.context.scene.render.engine = "BLENDER_WORKBENCH"
    assert not on_disk()


def test_the_first_picture_by_cycles_shows_the_human(person, tmp_path):
    scene = bpy.context.scene
    setup_cycles_preview(scene, size=16)
    scene.render.filepath = str(tmp_path / "picture.png")
    bpy.ops.render.render(write_still=True)
    check_complete(person)
    picture = bpy.data.images.load(scene.render.filepath)
    assert max(list(picture.pixels)[3::4]) > 0.2


def test_undo_redo_and_work_again(in_each_state):
    bpy.ops.ed.undo()
    assert not humans(bpy.context.scene)
    assert not late_volumes.work(0.0), "no human is left to write"
    bpy.ops.ed.redo()
    (person,) = humans(bpy.context.scene)
    advance("written")
    check_complete(person)


def test_a_deleted_human_is_not_written_on_and_comes_back_with_undo(in_each_state):
    before = on_disk()
    bpy.ops.ed.undo_push(message="stands")
    ops.delete_human(human=in_each_state.name)
    bpy.ops.ed.undo_push(message="deleted")
    assert not late_volumes.work(0.0)
    assert on_disk() == before
    bpy.ops.ed.undo()
    advance("written")
    check_complete(*humans(bpy.context.scene))


def test_saved_and_opened_again_the_rest_is_written(in_each_state):
    bpy.ops.wm.save_mainfile()
    late_volumes.stop()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    (person,) = humans(bpy.context.scene)
    look()
    assert state.summary == ""
    advance("written")
    check_complete(person)


@pytest.mark.parametrize("reached", STATES)
def test_the_first_save_takes_the_volumes_along_however_many_are_written(hidden, tmp_path, reached):
    bpy.ops.wm.read_homefile(use_empty=True)
    person = generated()
    temporary = folder_of(person)
    while reached != "unwritten" and len(on_disk(temporary)) < (COUNT if reached == "written" else COUNT // 2):
        assert late_volumes.work(0.0)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "film.blend"))
    assert folders_of(person)[0] == tmp_path / "film_humans" / "Human"
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "film.blend"))
    shutil.rmtree(temporary, ignore_errors=True)
    advance("written")
    check_complete(*humans(bpy.context.scene))


def test_the_blend_and_its_folder_may_be_moved_before_they_are_written(in_each_state, tmp_path):
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.read_homefile(use_empty=True)
    (tmp_path / "away").mkdir()
    shutil.move(tmp_path / "shot.blend", tmp_path / "away")
    shutil.move(tmp_path / "shot_humans", tmp_path / "away")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "away" / "shot.blend"))
    advance("written")
    check_complete(*humans(bpy.context.scene))


@pytest.mark.parametrize("link", [False, True])
def test_appended_or_linked_the_rest_is_written(in_each_state, tmp_path, link):
    bpy.ops.wm.save_mainfile()
    source = bpy.data.filepath
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(source, link=link) as (_, wanted):
        wanted.collections = ["Human"]
    bpy.context.scene.collection.children.link(bpy.data.collections["Human"])
    (person,) = humans(bpy.context.scene)
    advance("written")
    check_complete(person)


def test_a_library_override_of_a_human_is_written(in_each_state):
    bpy.ops.wm.save_mainfile()
    source = bpy.data.filepath
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(source, link=True) as (_, wanted):
        wanted.collections = ["Human"]
    linked = bpy.data.collections["Human"]
    bpy.context.scene.collection.children.link(linked)
    linked.override_hierarchy_create(bpy.context.scene, bpy.context.view_layer)
    person = next(person for person in humans(bpy.context.scene) if person.override_library is not None)
    advance("written")
    check_complete(person)


def test_an_edit_in_each_state_ends_with_the_volumes_of_the_edit(in_each_state):
    before = set(paths_of(in_each_state))
    assert ops.vary(human=in_each_state.name, seed=8, steps=1) == {"FINISHED"}
    drive()
    after = set(paths_of(in_each_state))
    assert before.isdisjoint(after)
    advance("written")
    check_complete(in_each_state)
    bpy.ops.ed.undo()
    (person,) = humans(bpy.context.scene)
    assert set(paths_of(person)) == before
    advance("written")
    check_complete(person)


def test_a_duplicate_shares_what_is_still_to_be_written(in_each_state):
    twin = duplicate_human(in_each_state)
    assert armature_of(twin).name in twin.children[0].objects
    advance("written")
    for person in (in_each_state, twin):
        check_complete(person)
    assert all(obj.parent == armature_of(twin) for objects in volumes_of(twin).values() for obj in objects)


def test_collected_files_include_what_is_still_to_be_written(in_each_state, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other.blend"))
    assert ops.collect_files() == {"FINISHED"}
    shutil.rmtree(tmp_path / "shot_humans")
    advance("written")
    check_complete(in_each_state)
    assert paths_of(in_each_state)[0].parent == tmp_path / "other_humans" / "Human"


def test_the_source_of_unwritten_volumes_is_unused_once_no_human_needs_it(person):
    source = unwritten_in(folder_of(person))
    assert not unused(humans_folder())
    ops.delete_human(human=person.name)
    assert set(source) <= set(unused(humans_folder()))


def test_shown_in_the_viewport_they_are_written_and_drawn(in_each_state):
    assert ops.volumes_in_viewport() == {"FINISHED"}
    check_complete(in_each_state)
    graph = bpy.context.evaluated_depsgraph_get()
    shown = [i.object for i in graph.object_instances if i.object.type == "VOLUME"]
    assert len(shown) == COUNT
    assert not any(obj.data.grids.error_message for obj in shown)
    assert ops.volumes_in_viewport(everyone=True) == {"FINISHED"}
    bpy.context.view_layer.update()
    graph = bpy.context.evaluated_depsgraph_get()
    assert not [i for i in graph.object_instances if i.object.type == "VOLUME"]


@pytest.mark.parametrize("mode", ["SURFACE", "ARMATURE"])
def test_hidden_volumes_stay_hidden_when_the_attachment_changes(person, mode):
    assert ops.set_attachment(mode=mode) == {"FINISHED"}
    bpy.context.view_layer.update()
    graph = bpy.context.evaluated_depsgraph_get()
    assert not [i for i in graph.object_instances if i.object.type == "VOLUME"]


def test_both_a_render_and_the_timer_may_write_the_same(person):
    (source,) = unwritten_in(folder_of(person))
    advance("half")
    for _ in write_unwritten(source):
        pass
    check_complete(person)
    assert not late_volumes.work(60.0)
    assert not list(folder_of(person).glob(".*.partial*"))


def test_a_full_disk_is_reported_once_and_a_render_tries_again(person, monkeypatch, capsys):
    def full(*_: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(unwritten, "write_file", full)
    while late_volumes.work(0.0):
        pass
    assert "could not be written" in late_volumes.error
    assert capsys.readouterr().out.count("could not be written") == 1
    assert not list(folder_of(person).glob(".*.partial*"))
    monkeypatch.undo()
    late_volumes.finish()
    assert late_volumes.error == ""
    check_complete(person)


def test_what_failed_is_tried_again_when_the_file_is_opened(person, monkeypatch):
    def full(*_: object) -> str:
        raise OSError(28, "No space left on device")

    bpy.ops.wm.save_mainfile()
    monkeypatch.setattr(unwritten, "write_file", full)
    while late_volumes.work(0.0):
        pass
    monkeypatch.undo()
    assert not late_volumes.work(0.0)
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert late_volumes.error == ""
    advance("written")
    check_complete(*humans(bpy.context.scene))


def test_a_changed_source_is_reported(person):
    (source,) = unwritten_in(folder_of(person))
    source.write_bytes(b"no human")
    while late_volumes.work(0.0):
        pass
    assert "is damaged" in late_volumes.error


def test_disabling_the_extension_leaves_no_unfinished_files(person):
    advance("half")
    blender_primdiffusion.unregister()
    assert not list(folder_of(person).glob(".*.partial*"))
    assert len(unwritten_in(folder_of(person))) == 1
    blender_primdiffusion.register()


def test_background_mode_writes_at_once(addon):
    assert ops.generate(seed=5) == {"FINISHED"}
    (person,) = humans(bpy.context.scene)
    assert all(path.is_file() for path in paths_of(person))
    assert person.children[0].hide_viewport


def test_the_memory_of_volumes_is_told_when_they_are_written(in_each_state):
    person_memory(in_each_state)
    write_all_unwritten()
    memory = person_memory(in_each_state)
    assert memory.files == sum(path.stat().st_size for path in paths_of(in_each_state))
    assert memory.grids > 0


def test_several_humans_are_written_one_after_another(hidden):
    people = [generated(seed) for seed in (11, 12)]
    began = time.monotonic()
    while late_volumes.work(0.0):
        assert time.monotonic() - began < 60
    for person in people:
        check_complete(person)
