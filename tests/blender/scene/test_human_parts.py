"""Parts of humans follow what Blender does to armatures: deleted with them, made for copies; undo leads back."""

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from human_files import copy_of, held, paths_of, press_x
from human_stage import build_posed, named, places, whole

from blender_primdiffusion.jobs import parts as module
from blender_primdiffusion.jobs.parts import complete_humans, orphans, without_parts
from blender_primdiffusion.scene.edit import reshape
from blender_primdiffusion.scene.human import PAYLOAD, PROXY_MARK, body_of, humans, parts_of
from blender_primdiffusion.scene.shape import betas_of
from blender_primdiffusion.scene.volume_nodes import volumes_of

ops = bpy.ops.primdiffusion
TALL = np.eye(10)[0] * 2.0


def left() -> list[str]:
    return sorted(obj.name for obj in bpy.data.objects)


def test_x_on_the_armature_takes_all_parts_and_nothing_else(person):
    cube = bpy.data.objects.new("Cube", bpy.data.meshes.new("Cube"))
    bpy.context.scene.collection.objects.link(cube)
    press_x(person)
    assert left() == ["Cube"]
    assert [mesh.name for mesh in bpy.data.meshes] == ["Cube"]
    assert not bpy.data.collections


def test_x_on_one_of_two_leaves_the_other_whole(person, source):
    berta = build_posed(source, "Berta")
    where = places(berta)
    press_x(named())
    assert whole(named("Berta"), where)
    assert len(parts_of(named("Berta"))) == len(left())


def test_a_mesh_proxy_goes_with_the_armature_and_a_hat_stays(person):
    hat = bpy.data.objects.new("Hat", None)
    proxy = body_of(person).copy()
    proxy[PROXY_MARK] = "{}"
    for obj in (hat, proxy):
        obj.parent = person
        bpy.context.scene.collection.objects.link(obj)
    press_x(person)
    assert left() == ["Hat"]


def test_undo_leads_back_over_the_removal_of_the_parts(person):
    bpy.ops.ed.undo_push(message="before")
    where, objects = places(person), left()
    person.select_set(True)
    bpy.ops.object.delete()
    bpy.ops.ed.undo_push(message="Delete")
    module.complete()
    assert left() == []
    bpy.ops.ed.undo()
    bpy.ops.ed.undo()
    assert left() == objects
    assert whole(named(), where)
    bpy.ops.ed.redo()
    bpy.ops.ed.redo()
    assert left() == []


@pytest.mark.parametrize("linked", [False, True], ids=["Shift-D", "Alt-D"])
def test_a_copy_of_the_armature_gets_parts_of_its_own_and_shares_the_file_until_an_edit(person, content, linked):
    where = places(person)
    person.select_set(True)
    bpy.context.view_layer.objects.active = person
    bpy.ops.object.duplicate(linked=linked)
    twin = bpy.context.view_layer.objects.active
    assert without_parts() == [twin]
    assert complete_humans()
    assert not complete_humans()
    assert volumes_of(twin).data != volumes_of(person).data
    assert body_of(twin) != body_of(person)
    np.testing.assert_allclose(places(twin), where, atol=1e-6)
    twin.location.x += 1.0
    assert whole(named(), where)
    assert paths_of(twin) == paths_of(person)
    assert twin[PAYLOAD] == person[PAYLOAD]
    ops.vary(human="Anna", seed=12)
    assert twin[PAYLOAD].packed_file.data == content[0] != held(named())[0]


def test_a_copy_has_the_shape_and_a_later_one_is_its_own(person):
    reshape(person, TALL)
    where = places(person)
    twin = copy_of(person)
    np.testing.assert_allclose(places(twin), where, atol=1e-5)
    reshape(twin, -TALL)
    np.testing.assert_allclose(betas_of(person), TALL)
    np.testing.assert_allclose(places(person), where, atol=1e-6)


def test_an_armature_appended_alone_becomes_whole(person, tmp_path):
    where = places(person)
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(str(tmp_path / "shot.blend")) as (_, wanted):
        wanted.objects = ["Anna"]
    bpy.context.scene.collection.objects.link(wanted.objects[0])
    module.complete()
    assert whole(named(), where)


def test_a_copy_whose_data_are_damaged_is_told_and_left(person, capsys):
    person.select_set(True)
    bpy.context.view_layer.objects.active = person
    bpy.ops.object.duplicate()
    del bpy.context.view_layer.objects.active["primdiffusion"]
    before = left()
    module.complete()
    assert "holds no data of a human" in capsys.readouterr().out
    assert left() == before


@pytest.fixture
def windowed(person, monkeypatch):
    """Handlers act as with a window; yields whether the timer is due."""
    app = SimpleNamespace(background=False, timers=bpy.app.timers)
    monkeypatch.setattr(module, "bpy", SimpleNamespace(app=app, data=bpy.data, ops=bpy.ops, context=bpy.context))
    module.look()
    yield lambda: bpy.app.timers.is_registered(module.tick)
    module.unregister()


def test_the_timer_is_due_where_an_armature_was_deleted(windowed):
    assert not windowed()
    named().select_set(True)
    bpy.ops.object.delete()
    bpy.context.view_layer.update()
    assert windowed()
    assert len(orphans()) == 2


def test_nothing_is_due_where_undo_has_led_until_objects_come_or_go(windowed):
    module.hold()
    bpy.data.objects.remove(named())
    module.look()
    module.look()
    assert not windowed(), "undo has led here"
    module.forget()
    module.look()
    assert windowed()


def test_operators_see_complete_humans(person):
    person.select_set(True)
    bpy.context.view_layer.objects.active = person
    bpy.ops.object.duplicate()
    assert ops.reshape(to="RANDOM", seed=3) == {"FINISHED"}
    assert all(volumes_of(one) for one in humans(bpy.context.scene))
