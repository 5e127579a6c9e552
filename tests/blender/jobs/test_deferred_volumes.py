"""Volumes written after their human stands: by the timer, by renders, when shown, and what stops them."""

from __future__ import annotations

import math
import time

import bpy
import pytest
from blender_primdiffusion.jobs.deferred_volumes import deferred_volumes
from blender_primdiffusion.scene.pending import pending_of, pending_volumes, write_all_pending, write_pending
from blender_primdiffusion.scene.surface import primitives_of
from deferred_volumes_stage import COUNT, advance, check_complete, generated, on_disk, paths_of
from human_files import folder_of, person_file

import blender_primdiffusion
from blender_primdiffusion.engine.gpu.overlay import overlay
from blender_primdiffusion.jobs import deferred_volumes as module
from blender_primdiffusion.jobs import windows
from blender_primdiffusion.scene import volumes
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.cycles import setup_cycles_preview
from blender_primdiffusion.scene.human import humans, volumes_of
from blender_primdiffusion.scene.volumes import person_memory

ops = bpy.ops.primdiffusion


def test_the_human_stands_before_any_volume_is_written(person):
    assert not on_disk()
    assert pending_of(person).primitives == tuple(range(COUNT))
    assert len(volumes_of(person)) == COUNT
    assert person_file(person).is_file()
    assert person.visible_get()


def test_the_files_written_later_are_those_that_would_be_written_at_once(person, tmp_path):
    write_all_pending()
    check_complete(person)
    at_once = build_human(bpy.context, tmp_path / "prepared" / "person.human.safetensors", "Anna")
    later = {path.name: path for path in paths_of(person)}
    write_all_pending()
    for path in paths_of(at_once):
        assert later[path.name].stat().st_size == path.stat().st_size


def test_hidden_volumes_cost_the_viewport_nothing_and_renders_have_them(person):
    graph = bpy.context.evaluated_depsgraph_get()
    assert not [instance for instance in graph.object_instances if instance.object.type == "VOLUME"]
    assert not any(isinstance(block, bpy.types.Volume) for block in graph.ids)
    primitives = primitives_of(person)
    assert primitives.hide_viewport
    assert not primitives.hide_render
    assert person.name in primitives.objects


def test_a_slice_is_as_long_as_the_drawing_before_it_within_limits(person, monkeypatch):
    given, now = [], [100.0]
    monkeypatch.setattr(windows, "_last_undo", -math.inf)  # an undo of another test lies in this clock's future
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(deferred_volumes, "work", lambda seconds: given.append(round(seconds, 3)) or True)
    for drawing in (0.0, 0.07, 3.0):
        deferred_volumes._ended = now[0]
        now[0] += module.PAUSE_S + drawing
        assert deferred_volumes.tick() == module.PAUSE_S
    assert given == [module.SHORTEST_S, 0.07, module.LONGEST_S]


def test_views_that_show_the_human_come_before_its_volumes(person, monkeypatch):
    monkeypatch.setattr(overlay, "undrawn", True)
    assert deferred_volumes.tick() == module.BLOCKED_S
    assert not on_disk()


def test_the_timer_waits_for_what_the_user_holds_and_ends_with_the_work(person, monkeypatch):
    monkeypatch.setattr(module, "in_the_way", lambda: "Move")
    assert deferred_volumes.tick() == module.BLOCKED_S
    assert not on_disk()
    monkeypatch.undo()
    while deferred_volumes.tick() is not None:
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
    (pending,) = pending_volumes()
    advance("half")
    for _ in write_pending(pending):
        pass
    check_complete(person)
    while deferred_volumes.work(60.0):
        pass
    assert not list(folder_of(person).glob(".*.partial*"))


def test_a_full_disk_is_reported_once_and_a_render_tries_again(person, monkeypatch, capsys):
    def full(*_: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(volumes, "write_vdb", full)
    while deferred_volumes.work(0.0):
        pass
    assert "No space left" in deferred_volumes.error
    assert capsys.readouterr().out.count("No space left") == 1
    assert not list(folder_of(person).glob(".*.partial*"))
    monkeypatch.undo()
    deferred_volumes.finish()
    assert deferred_volumes.error == ""
    check_complete(person)


def test_disabling_the_extension_leaves_no_unfinished_files(person):
    advance("half")
    blender_primdiffusion.unregister()
    assert not list(folder_of(person).glob(".*.partial*"))
    assert pending_of(person) is not None
    blender_primdiffusion.register()


def test_background_mode_writes_at_once(addon):
    assert ops.generate(seed=5) == {"FINISHED"}
    (person,) = humans(bpy.context.scene)
    assert all(path.is_file() for path in paths_of(person))
    assert primitives_of(person).hide_viewport


def test_the_memory_of_volumes_is_told_when_they_are_written(in_each_state):
    person_memory(in_each_state)
    write_all_pending()
    memory = person_memory(in_each_state)
    assert memory.files == sum(path.stat().st_size for path in paths_of(in_each_state))
    assert memory.grids > 0


def test_several_humans_are_written_one_after_another(hidden):
    people = [generated(seed) for seed in (11, 12)]
    began = time.monotonic()
    while deferred_volumes.work(0.0):
        assert time.monotonic() - began < 300
    for person in people:
        check_complete(person)
