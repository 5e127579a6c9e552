"""People are whole after undo and edits, in linked and appended files, and after Blender's own copies."""

import os

import bpy
import numpy as np
import psutil
import pytest
import synthetic_shape
from human_files import forget_session_files, held, person_file, press_x
from human_stage import named, places, whole
from support.errors import refused
from support.fake_child import request_of

from blender_primdiffusion.jobs.parts import complete_humans
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import humans, is_human, parts_of

ops = bpy.ops.primdiffusion


def step(name: str) -> None:
    bpy.ops.ed.undo_push(message=name)


def test_undo_and_redo_across_generate_edit_reshape_and_delete(source, addon):
    step("empty")
    ops.generate(seed=7)
    generated = places(humans(addon.scene)[0])
    ops.vary(seed=12)
    ops.reshape(to="RANDOM", seed=3)
    step("reshape")
    reshaped = places(humans(bpy.context.scene)[0])
    press_x(humans(bpy.context.scene)[0])
    step("delete")
    assert not humans(bpy.context.scene)
    bpy.ops.ed.undo()
    assert whole(humans(bpy.context.scene)[0], reshaped)
    bpy.ops.ed.undo()
    assert whole(humans(bpy.context.scene)[0], generated)
    bpy.ops.ed.undo()
    person = humans(bpy.context.scene)[0]
    assert whole(person, generated)
    assert request_of(person_file(person))["seed"] == 7
    bpy.ops.ed.undo()
    assert not humans(bpy.context.scene)
    for _ in range(3):
        bpy.ops.ed.redo()
    assert whole(humans(bpy.context.scene)[0], reshaped)


def test_appended_people_are_whole_and_can_be_edited(person, content, tmp_path):
    where, other = places(person), tmp_path / "other"
    other.mkdir()
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(other / "film.blend"))
    bpy.ops.wm.append(directory=str(tmp_path / "shot.blend" / "Collection") + os.sep, filename="Anna")
    forget_session_files()
    assert held(named()) == content
    assert whole(named(), where)
    assert ops.vary(human="Anna", seed=13) == {"FINISHED"}
    assert whole(named(), where)
    bpy.ops.wm.save_mainfile()
    (tmp_path / "shot.blend").unlink()
    forget_session_files()
    bpy.ops.wm.open_mainfile(filepath=str(other / "film.blend"))
    assert whole(named(), where)


def linked(tmp_path, folder="other"):
    (tmp_path / folder).mkdir()
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / folder / "film.blend"))
    with bpy.data.libraries.load(str(tmp_path / "shot.blend"), link=True, relative=True) as (_, wanted):
        wanted.collections = ["Anna"]
    bpy.context.scene.collection.children.link(wanted.collections[0])
    return bpy.data.objects["Anna"]


def test_linked_people_are_whole_and_reject_edits(person, content, tmp_path):
    where = places(person)
    anna = linked(tmp_path)
    forget_session_files()
    assert not complete_humans(), "it stays as it is"
    assert held(anna) == content
    assert whole(anna, where)
    for operator in (ops.vary, ops.reshape):
        with refused(RuntimeError, "linked"):
            operator()
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert whole(named(), where)


def test_linked_people_with_overrides_can_be_posed(person, content, tmp_path):
    linked(tmp_path)
    made = bpy.data.collections["Anna"].override_hierarchy_create(bpy.context.scene, bpy.context.view_layer)
    override = next(filter(is_human, made.all_objects))
    armature = override
    armature.pose.bones["head"].rotation_quaternion = (0.9, 0.1, 0.2, 0.1)
    armature.location.x = 3
    where = places(override)
    assert whole(override, where)
    with refused(RuntimeError, "linked"):
        ops.vary(human=override.name)
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    override = next(one for one in humans(bpy.context.scene) if one.library is None)
    assert held(override) == content
    assert whole(override, where)


def test_made_local(person, tmp_path):
    where = places(person)
    linked(tmp_path)
    bpy.ops.object.make_local(type="ALL")
    anna = named()
    assert whole(anna, where)


def test_blenders_own_duplicate_of_all_parts(person):
    where = places(person)
    for obj in list(parts_of(person)):
        obj.hide_viewport = False
        obj.select_set(True)
    bpy.ops.object.duplicate()
    assert len(bpy.context.selected_objects) == 3
    bpy.data.batch_remove([obj for obj in bpy.context.selected_objects])
    assert whole(person, where)


@pytest.mark.parametrize("kind", ["LINK_COPY", "FULL_COPY"])
def test_copies_of_a_scene(person, kind):
    where, first = places(person), bpy.context.scene
    bpy.ops.scene.new(type=kind)
    (there,) = humans(bpy.context.scene)
    assert whole(there, where)
    assert (there == person) == (kind == "LINK_COPY")
    bpy.data.scenes.remove(bpy.context.scene)
    bpy.context.window.scene = first
    assert whole(named(), where)


def test_two_scenes_share_a_person(person):
    other = bpy.data.scenes.new("Other")
    other.collection.children.link(bpy.data.collections[person.name])
    first = bpy.context.scene
    ops.vary(seed=14)
    for scene in (first, other):
        bpy.context.window.scene = scene
        assert whole(person)


def test_names_and_collections_of_parts_may_change(person):
    where = [list(row) for row in places(person)]
    person.users_collection[0].name = "Wer?"
    for number, obj in enumerate(person.children):
        obj.name = f"x{number}"
    person.name = "Rig"
    bpy.ops.wm.save_mainfile()
    assert whole(named("Rig"), where)
    ops.vary(seed=14)
    assert whole(named("Rig"), where)


def test_the_armature_turned_and_scaled_in_a_scene_of_centimetres(person):
    bpy.context.scene.unit_settings.scale_length = 0.01
    bpy.context.scene.render.fps = 60
    armature = person
    before, old = places(person), np.array(armature.matrix_world)
    armature.scale, armature.rotation_euler = (100, 100, 100), (0.3, 0.2, 1.0)
    bpy.context.view_layer.update()
    moved = np.array(armature.matrix_world) @ np.linalg.inv(old)
    np.testing.assert_allclose(places(person), moved @ before, atol=1e-4)
    assert whole(person)


def test_edits_do_not_pile_up_grids(source, monkeypatch):
    npz = synthetic_shape.write(source / "large", 64)
    monkeypatch.setenv("FAKE_HUMAN", str(npz))
    build_human(bpy.context, npz, "Anna")
    ops.volumes_in_viewport()
    ops.vary(seed=11)
    before = psutil.Process().memory_info().rss
    for seed in (12, 13):
        ops.vary(seed=seed)
        bpy.context.view_layer.update()
    grown = (psutil.Process().memory_info().rss - before) / 1e6
    assert grown < 50, f"two edits of 64 grids of 0.9 MB: {grown:.0f} MB more"
