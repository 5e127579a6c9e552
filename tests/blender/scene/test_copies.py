"""Armatures copied by Blender's own operators become humans of their own: Shift-D, Alt-D, with and without children."""

from __future__ import annotations

import time

import bpy
import numpy as np
import pytest
from human_stage import COUNT, build_posed, named, whole
from human_stage import places as places_of_shown

from blender_primdiffusion.jobs import copies, windows
from blender_primdiffusion.jobs.target import selected_person
from blender_primdiffusion.scene.attachment import set_attachment
from blender_primdiffusion.scene.cycles import setup_cycles_preview
from blender_primdiffusion.scene.human import armature_of, body_of, humans, volumes_of
from blender_primdiffusion.scene.stand_in import STAND_IN

ops = bpy.ops.primdiffusion


@pytest.fixture(autouse=True)
def at_rest(monkeypatch):
    """Undo in tests before lies long back."""
    monkeypatch.setattr(windows, "UNDO_REST_S", 0.0)
    copies.forget()


def copy_of(armature, linked=False, others=()) -> bpy.types.Object:
    """What Shift-D or Alt-D makes of an armature, moved two metres."""
    bpy.ops.object.select_all(action="DESELECT")
    for obj in (armature, *others):
        obj.select_set(True)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.duplicate(linked=linked)
    copy = bpy.context.view_layer.objects.active
    assert copy != armature
    copy.location.x += 2.0
    bpy.ops.ed.undo_push(message="Duplicate Objects")
    return copy


def places(person) -> np.ndarray:
    """Where the volumes are, which viewports hide."""
    hidden, person.children[0].hide_viewport = person.children[0].hide_viewport, False
    found = places_of_shown(person)
    assert np.abs(found - np.eye(4)).max(axis=(1, 2)).min() > 0.1, "they are evaluated"
    person.children[0].hide_viewport = hidden
    return found


def names() -> list[str]:
    return sorted(person.name for person in humans(bpy.context.scene))


def check_apart(person, copy, *, count=2) -> None:
    """Both are whole, and nothing of one follows or is in the other."""
    assert len(humans(bpy.context.scene)) == count
    for one in (person, copy):
        assert whole(one)
        armature = armature_of(one)
        assert [obj for obj in one.all_objects if obj.type == "ARMATURE"] == [armature]
        assert body_of(one).parent == armature
        assert body_of(one).modifiers["Armature"].object == armature
        assert {obj.parent for objects in volumes_of(one).values() for obj in objects} == {armature}
        targets = {
            target.target
            for objects in volumes_of(one).values()
            for obj in objects
            for constraint in obj.constraints
            for target in constraint.targets
        }
        assert targets == {armature}
        assert one.children[0].hide_viewport
        assert armature.name in one.children[0].objects
    assert not set(person.all_objects) & set(copy.all_objects)


@pytest.mark.parametrize("linked", [False, True])
def test_a_copy_becomes_a_human_at_rest(person, linked):
    where = places(person)
    armature = copy_of(armature_of(person), linked)
    assert names() == ["Anna"]
    assert copies.tick() is None
    assert names() == ["Anna", "Anna.001"]
    copy = named("Anna.001")
    assert armature_of(copy) == armature
    assert (armature.data == armature_of(person).data) == linked
    check_apart(person, copy)
    where[:, 0, 3] += 2.0
    np.testing.assert_allclose(places(copy), where, atol=1e-5)
    assert {obj.data for obj in copy.all_objects if obj.type == "VOLUME"} == {
        obj.data for obj in person.all_objects if obj.type == "VOLUME"
    }


def test_the_copy_stays_selected_and_the_panel_names_it(person):
    armature = copy_of(armature_of(person))
    copies.tick()
    assert bpy.context.view_layer.objects.active == armature
    assert bpy.context.selected_objects == [armature]
    assert selected_person(bpy.context).name == "Anna.001"


def test_nothing_is_made_while_the_user_drags(person, monkeypatch):
    copy_of(armature_of(person))
    monkeypatch.setattr(copies, "in_the_way", lambda: "Move")
    assert copies.tick() == copies.SOON_S
    assert names() == ["Anna"]


def test_a_copy_of_a_copy_and_two_at_once(person):
    first = copy_of(armature_of(person))
    second = copy_of(first)
    copies.tick()
    third = copy_of(second)
    copies.tick()
    assert names() == ["Anna", "Anna.001", "Anna.002", "Anna.003"]
    people = [named(name) for name in names()]
    assert {armature_of(one) for one in people[1:]} == {first, second, third}
    for one in people[1:]:
        check_apart(person, one, count=4)


@pytest.mark.parametrize("linked", [False, True])
@pytest.mark.usefixtures("volumes_shown")
def test_what_was_copied_with_the_armature_is_used(source, linked):
    person = build_posed(source)
    person.children[0].hide_viewport = False
    body_of(person).hide_viewport = False
    children = [obj for obj in person.all_objects if obj.type in ("VOLUME", "MESH") and STAND_IN not in obj]
    hat = bpy.data.objects.new("hat", None)
    hat.parent = armature_of(person)
    person.objects.link(hat)
    armature = copy_of(armature_of(person), linked, [*children, hat])
    made = {obj for obj in bpy.context.selected_objects if obj != armature}
    before = len(bpy.data.objects)
    copies.tick()
    assert len(bpy.data.objects) == before + 1, "nothing is copied twice; what stands in for a human cannot be selected"
    copy = named("Anna.001")
    assert made <= set(copy.all_objects)
    assert hat.name in person.objects
    for one in (person, copy):
        assert len([obj for obj in one.all_objects if obj.type == "VOLUME"]) == COUNT
        assert body_of(one).parent == armature_of(one)
    assert whole(person)
    assert whole(copy)


def test_only_some_children_were_copied(person):
    body = body_of(person)
    body.hide_viewport = False
    copy_of(armature_of(person), False, [body])
    copies.tick()
    check_apart(person, named("Anna.001"))


def test_edits_and_shapes_of_one_leave_the_other(person):
    where = places(person)
    armature = copy_of(armature_of(person), linked=True)
    assert ops.reshape(height=1.6) == {"FINISHED"}, "an operator makes the human first"
    assert names() == ["Anna", "Anna.001"]
    np.testing.assert_allclose(places(person), where, atol=1e-5)
    assert ops.vary(human="Anna.001", seed=13) == {"FINISHED"}
    np.testing.assert_allclose(places(person), where, atol=1e-5)
    assert armature_of(named("Anna.001")) == armature
    check_apart(named(), named("Anna.001"))


@pytest.mark.parametrize("settled", [True, False])
def test_the_original_is_deleted(person, settled):
    where = places(person)
    armature = copy_of(armature_of(person))
    if settled:
        copies.tick()
        assert ops.delete_human(human="Anna") == {"FINISHED"}
    else:
        bpy.data.objects.remove(armature_of(person))
        copies.tick()
    (left,) = humans(bpy.context.scene)
    assert armature_of(left) == armature
    where[:, 0, 3] += 2.0
    assert whole(left)
    np.testing.assert_allclose(places(left), where, atol=1e-5)
    assert body_of(left).modifiers["Armature"].object == armature


def test_the_original_is_deleted_before_two_copies_are_humans(person):
    first = copy_of(armature_of(person))
    second = copy_of(first)
    bpy.data.objects.remove(armature_of(person))
    copies.tick()
    assert len(names()) == 2
    assert {armature_of(one) for one in humans(bpy.context.scene)} == {first, second}
    check_apart(*humans(bpy.context.scene))


def test_undo_right_after_leads_back_through_the_bare_copy(person, monkeypatch):
    bpy.ops.ed.undo_push(message="before")
    copy_of(armature_of(person))
    copies.tick()
    bpy.ops.ed.undo()
    assert names() == ["Anna"]
    copies.look()
    copies.tick()
    assert names() == ["Anna"], "or undo would lead nowhere"
    bpy.ops.ed.undo()
    assert [obj.name for obj in named().objects if obj.type == "ARMATURE"] == ["Anna"]
    assert whole(named())
    for _ in range(2):
        bpy.ops.ed.redo()
    check_apart(named(), named("Anna.001"))
    bpy.ops.ed.undo()
    monkeypatch.setattr(copies, "UNDONE_S", -1.0)  # the next change comes later
    copies.look()
    copies.tick()
    check_apart(named(), named("Anna.001"))


def test_undo_leads_back_also_where_evaluating_the_scene_takes_long(person, monkeypatch):
    copy_of(armature_of(person))
    copies.tick()
    monkeypatch.setattr(copies, "UNDONE_S", 0.1)
    evaluating = bpy.app.handlers.depsgraph_update_pre
    evaluating.append(slowly := lambda *_: time.sleep(0.2))
    try:
        bpy.ops.ed.undo()
    finally:
        evaluating.remove(slowly)
    copies.tick()
    assert names() == ["Anna"], "the update is undo's own"
    time.sleep(0.2)
    copies.look()
    copies.tick()
    check_apart(named(), named("Anna.001"))


def test_the_first_render_shows_the_copy(person, tmp_path):
    copy_of(armature_of(person))
    scene = bpy.context.scene
    setup_cycles_preview(scene, size=32)
    scene.camera.location.x += 1.0
    scene.camera.data.lens = 25.0
    scene.render.filepath = str(tmp_path / "picture.png")
    bpy.ops.render.render(write_still=True)
    assert names() == ["Anna", "Anna.001"]
    check_apart(named(), named("Anna.001"))
    picture = bpy.data.images.load(scene.render.filepath)
    alpha = np.array(picture.pixels).reshape(32, 32, 4)[..., 3]
    assert alpha[:, :16].max() > 0.2
    assert alpha[:, 16:].max() > 0.2


def test_saved_before_it_is_a_human_it_becomes_one_after_loading(person):
    copy_of(armature_of(person))
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    copies.tick()
    check_apart(named(), named("Anna.001"))
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    check_apart(named(), named("Anna.001"))


@pytest.mark.parametrize("mode", ["SURFACE", "ARMATURE"])
def test_the_attachment_is_copied(person, mode):
    set_attachment(person, mode)
    copy_of(armature_of(person))
    copies.tick()
    check_apart(person, named("Anna.001"))
    shown = [obj for obj in named("Anna.001").all_objects if "primdiffusion_surface" in obj]
    assert len(shown) == (mode == "SURFACE")
    assert {obj.parent for obj in shown} <= {armature_of(named("Anna.001"))}


def test_an_action_is_shared_or_copied_as_blender_has_done_it(person):
    armature = armature_of(person)
    armature.animation_data_create().action = bpy.data.actions.new("Walk")
    for linked in (False, True):
        copy = copy_of(armature, linked)
        action = copy.animation_data.action
        copies.tick()
        assert copy.animation_data.action == action
    assert len(names()) == 3


def test_other_armatures_in_a_humans_collection_stay(person):
    rig = bpy.data.objects.new("rig", bpy.data.armatures.new("rig"))
    person.objects.link(rig)
    copies.tick()
    assert names() == ["Anna"]
    assert rig.name in person.objects


def test_linked_humans_stay_as_they_are(person, tmp_path):
    blend = bpy.data.filepath
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.link(directory=f"{blend}/Collection/", filename="Anna", instance_collections=True)
    bpy.ops.object.duplicate()
    before = len(bpy.data.collections)
    copies.tick()
    assert len(bpy.data.collections) == before
