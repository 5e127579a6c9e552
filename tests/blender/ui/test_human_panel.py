"""The panel Human: who is meant, their name, their shape, and what becomes of people as wholes."""

from __future__ import annotations

import json
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np
import pytest
import synthetic
import synthetic_shape
from human_files import folder_of, person_file
from jobs_driven import shown
from oracle import evaluated_matrices
from support.errors import refused

from blender_primdiffusion.scene import shape
from blender_primdiffusion.scene.armature import keyframe_poses
from blender_primdiffusion.scene.attachment import set_attachment
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.edit import reshape
from blender_primdiffusion.scene.human import BETAS, MARK, armature_of, body_of, humans
from blender_primdiffusion.scene.rest_human import shape_model_of
from blender_primdiffusion.scene.shape import betas_of, generated_betas, measure, slider_names
from blender_primdiffusion.scene.surface import node_inputs
from blender_primdiffusion.ui.advanced_panel import PRIMDIFFUSION_PT_advanced
from blender_primdiffusion.ui.human_panel import PRIMDIFFUSION_MT_people, PRIMDIFFUSION_PT_human
from blender_primdiffusion.ui.shape_panel import (
    PRIMDIFFUSION_OT_reshape,
    PRIMDIFFUSION_PT_shape,
)

pytestmark = pytest.mark.usefixtures("volumes_shown")

ops = bpy.ops.primdiffusion
TALL = [2.0] + [0.0] * 9


@pytest.fixture
def person(addon, tmp_path):
    return build_human(addon, synthetic_shape.write(tmp_path / "human"))


@pytest.fixture
def other(person, addon, tmp_path):
    return build_human(addon, synthetic_shape.write(tmp_path / "other", seed=3), "Ötzi")


def settings(person):
    return armature_of(person).primdiffusion_human


def height(person) -> float:
    z = [vertex.co.z for vertex in body_of(person).data.vertices]
    return max(z) - min(z)


def surface(person) -> list:
    return [list(vertex.co) for vertex in body_of(person).data.vertices]


def world(person) -> np.ndarray:
    bpy.context.view_layer.update()
    return evaluated_matrices(person)


def test_a_slider_moves_the_person(person):
    settings(person).betas[0] = 1.5
    np.testing.assert_allclose(betas_of(person), [1.5, *generated_betas(person)[1:]], atol=1e-5)
    wanted = shape_model_of(person).surface(betas_of(person))
    assert height(person) == pytest.approx(np.ptp(wanted[:, 1]), abs=1e-5)


def test_height_and_weight_match_the_sliders(person):
    settings(person).height = 1.65
    assert height(person) == pytest.approx(1.65, abs=2e-4)
    before = measure(shape_model_of(person), betas_of(person)).weight
    assert settings(person).weight == pytest.approx(before, rel=1e-5)
    settings(person).weight = before * 1.05
    assert settings(person).weight == pytest.approx(before * 1.05, abs=2e-2)
    assert height(person) == pytest.approx(1.65, abs=3e-4)


def test_impossible_heights_leave_the_human_unchanged(person, capsys):
    before = surface(person)
    settings(person).height = 2.9
    assert surface(person) == before
    assert "no body of this model has a height of 2.90 m" in capsys.readouterr().out
    with refused(RuntimeError, "2.90"):
        ops.reshape(height=2.9)


def test_one_undo_takes_a_slider_back_and_redo_brings_it_again(person):
    def state():
        """Bones, mesh, volumes and betas."""
        (someone,) = humans(bpy.context.scene)
        heads = [list(bone.head_local) for bone in armature_of(someone).data.bones]
        return heads, surface(someone), world(someone).tolist(), betas_of(someone).tolist()

    bpy.ops.ed.undo_push(message="before")
    before = state()
    settings(person).betas = TALL
    after = state()
    assert all(new != old for new, old in zip(after, before, strict=True))
    bpy.ops.ed.undo_push(message="Shape")
    bpy.ops.ed.undo()
    assert state() == before
    bpy.ops.ed.redo()
    assert state() == after
    np.testing.assert_allclose(after[3], TALL)


def test_sliders_of_a_human_without_a_shape_do_nothing_and_the_panel_explains_why(person, addon):
    addon.view_layer.objects.active = armature_of(person)
    bpy.ops.object.mode_set(mode="EDIT")
    before = list(armature_of(person)[BETAS])
    settings(person).betas = TALL
    assert list(armature_of(person)[BETAS]) == before
    assert "Edit Mode: leave it" in " ".join(shown(PRIMDIFFUSION_PT_shape, addon))
    with refused(RuntimeError, "Edit Mode"):
        ops.reshape(to="GENERATED")
    bpy.ops.object.mode_set(mode="OBJECT")


def test_an_animated_shape_is_reported(person, addon):
    armature_of(person).keyframe_insert(f'["{BETAS}"]', frame=1)
    assert "animated" in " ".join(shown(PRIMDIFFUSION_PT_shape, addon))


def test_reset_brings_back_the_shape_the_person_was_generated_with(person):
    before = surface(person)
    reshape(person, np.array(TALL))
    assert ops.reshape(to="GENERATED") == {"FINISHED"}
    np.testing.assert_allclose(surface(person), before, atol=1e-5)


def test_a_random_shape_is_the_same_for_the_same_seed(person):
    ops.reshape(to="RANDOM", seed=5)
    first = betas_of(person)
    ops.reshape(to="RANDOM", seed=6)
    assert np.abs(betas_of(person) - first).max() > 0.1
    ops.reshape(to="RANDOM", seed=5)
    np.testing.assert_array_equal(betas_of(person), first)
    ops.reshape(to="RANDOM", seed=5, spread=0.0)
    assert not betas_of(person).any()


def test_each_press_of_random_is_another_body(person, addon):
    pressed = [
        SimpleNamespace(to="RANDOM", seed=0, given=lambda _: False, execute=lambda _: {"FINISHED"}) for _ in range(2)
    ]
    for press in pressed:  # background mode has no window to press a button in
        assert PRIMDIFFUSION_OT_reshape.invoke(press, addon, None) == {"FINISHED"}
    assert pressed[0].seed != pressed[1].seed


def test_a_shape_is_copied_from_the_other_person(person, other):
    reshape(other, np.array(TALL))
    assert ops.reshape(to="OTHER", human="Human", other="Ötzi") == {"FINISHED"}
    np.testing.assert_allclose(betas_of(person), TALL)
    bpy.context.scene.primdiffusion_edit.other = person
    reshape(person, np.zeros(10))
    assert ops.reshape(to="OTHER", human="Ötzi") == {"FINISHED"}
    assert not betas_of(other).any()


@pytest.mark.parametrize(
    ("given", "sentence"),
    [({}, "choose the other human"), ({"other": "Human"}, "cannot be the other"), ({"other": "Eve"}, "not in the")],
)
def test_copying_without_another_human_is_rejected(person, given, sentence):
    with pytest.raises(RuntimeError, match=sentence):
        ops.reshape(to="OTHER", **given)


def test_a_script_gives_betas_and_measures(person):
    ops.reshape(betas=TALL)
    np.testing.assert_allclose(betas_of(person), TALL)
    ops.reshape(height=1.7)
    assert height(person) == pytest.approx(1.7, abs=2e-4)
    with refused(RuntimeError, "-5 to 5"):
        ops.reshape(betas=[9.0] * 10)


def test_a_new_name_is_the_collections_and_its_parts_but_not_of_those_renamed_by_hand(person):
    hat = body_of(person)
    hat.name = "Skin"
    files = sorted(folder_of(person).iterdir())
    settings(person).person = "Jürgen  "
    assert person.name == settings(person).person == "Jürgen"
    assert armature_of(person).name == armature_of(person).data.name == "Jürgen"
    assert hat.name == "Skin"
    assert {obj.name[:12] for obj in person.all_objects if obj.type == "VOLUME"} == {"Jürgen_prim_"}
    assert person.children[0].name == "Jürgen_primitives"
    assert person_file(person).parent == files[0].parent
    assert sorted(files[0].parent.iterdir()) == files


def test_an_empty_name_is_rejected_and_a_taken_one_gets_a_number(person, other, capsys):
    settings(person).person = "  "
    assert "needs a name" in capsys.readouterr().out
    settings(person).person = "Ötzi"
    assert person.name == "Ötzi.001"
    assert other.name == "Ötzi"


def test_choosing_a_person_makes_their_armature_active(person, other, addon):
    with refused(RuntimeError, "2 humans"):
        ops.select_human()
    assert "2 humans are in the scene: select" in shown(PRIMDIFFUSION_PT_human, addon)
    assert shown(PRIMDIFFUSION_MT_people, addon).count("primdiffusion.select_human") == 2
    ops.select_human(human="Ötzi")
    assert addon.view_layer.objects.active == armature_of(other)
    assert list(addon.selected_objects) == [armature_of(other)]
    ops.select_human(human="Human")
    assert list(addon.selected_objects) == [armature_of(person)]
    with refused(RuntimeError, "Eve"):
        ops.select_human(human="Eve")


def test_a_view_is_needed_to_frame_a_human(person, addon):
    for window in addon.window_manager.windows:
        for area in window.screen.areas:
            area.type = "CONSOLE"
    with refused(RuntimeError, "viewport"):
        ops.select_human(frame=True)


def test_a_duplicate_is_a_person_of_their_own(person, addon):
    rotations = synthetic.axis_angle(np.random.default_rng(1).normal(0, 0.5, (1, 24, 3)))
    keyframe_poses(armature_of(person), np.array([1]), rotations, np.zeros((1, 3)))
    ops.duplicate_human()
    twin = next(one for one in humans(addon.scene) if one != person)
    assert twin.name == "Human.001"
    assert addon.view_layer.objects.active == armature_of(twin)
    move = np.array(armature_of(twin).location - armature_of(person).location)
    assert np.linalg.norm(move) > 0.3  # beside, not inside
    shift = np.eye(4)
    shift[:3, 3] = move
    np.testing.assert_allclose(world(twin), shift @ world(person), atol=1e-5)
    before, places = surface(person), world(person)
    ops.reshape(human=twin.name, betas=TALL)
    armature_of(twin).pose.bones["left_elbow"].rotation_quaternion = (0, 1, 0, 0)
    armature_of(twin).animation_data.action.layers[0].strips[0].channelbags[0].fcurves[0].keyframe_points[0].co.y = 9
    assert surface(person) == before
    np.testing.assert_array_equal(world(person), places)
    assert body_of(twin).modifiers[0].object == armature_of(twin)
    assert {obj.data for obj in twin.all_objects if obj.type == "VOLUME"} == {
        obj.data for obj in person.all_objects if obj.type == "VOLUME"
    }
    assert person_file(twin) == person_file(person)


def test_a_duplicate_on_the_posed_surface_follows_its_own_body(person, addon):
    set_attachment(person, "SURFACE")
    ops.duplicate_human()
    twin = bpy.data.collections["Human.001"]
    nodes = next(one for obj in twin.all_objects for one in obj.modifiers if one.type == "NODES")
    pointed = {value for value in node_inputs(nodes).values() if isinstance(value, bpy.types.ID)}
    assert body_of(twin) in pointed
    assert pointed <= {*twin.all_objects, *twin.children_recursive}


def test_undo_and_redo_of_a_duplicate_and_of_a_removal(person):
    bpy.ops.ed.undo_push(message="before")
    ops.duplicate_human()
    bpy.ops.ed.undo_push(message="Duplicate Human")
    assert len(humans(bpy.context.scene)) == 2
    ops.delete_human(human="Human")
    bpy.ops.ed.undo_push(message="Delete Human")
    assert [one.name for one in humans(bpy.context.scene)] == ["Human.001"]
    bpy.ops.ed.undo()
    assert sorted(one.name for one in humans(bpy.context.scene)) == ["Human", "Human.001"]
    assert all(volume.grids.load() for volume in bpy.data.volumes)
    bpy.ops.ed.undo()
    assert [one.name for one in humans(bpy.context.scene)] == ["Human"]
    bpy.ops.ed.redo()
    assert len(humans(bpy.context.scene)) == 2


def test_deleting_leaves_the_twin_the_files_and_nothing_else(person, addon):
    ops.duplicate_human()
    files = sorted(folder_of(person).parent.rglob("*"))
    places = world(bpy.data.collections["Human.001"])
    addon.view_layer.objects.active = armature_of(person)
    bpy.ops.object.mode_set(mode="EDIT")
    assert ops.delete_human() == {"FINISHED"}
    (twin,) = humans(addon.scene)
    np.testing.assert_array_equal(world(twin), places)
    assert ops.delete_human() == {"FINISHED"}
    assert not bpy.data.objects
    assert not bpy.data.armatures
    assert not bpy.data.volumes
    assert sorted((files[0].parent).rglob("*")) == files
    with refused(RuntimeError, "human"):
        ops.delete_human()


def linked(tmp_path):
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(str(tmp_path / "shot.blend"), link=True) as (_, wanted):
        wanted.collections = ["Human"]
    bpy.context.scene.collection.children.link(wanted.collections[0])
    return wanted.collections[0]


def test_a_linked_person_keeps_their_name(person, tmp_path, capsys):
    settings(linked(tmp_path)).person = "Mine"
    assert "is linked from" in capsys.readouterr().out


def test_a_frame_is_put_around_a_human_where_a_viewport_is_open(person, addon):
    area = next(iter(addon.window_manager.windows)).screen.areas[0]
    area.type = "VIEW_3D"
    view = area.spaces.active.region_3d
    view.view_location, view.view_distance = (50, 50, 50), 1.0
    assert ops.select_human(frame=True) == {"FINISHED"}
    assert view.view_location.length < 3
    assert addon.view_layer.objects.active == armature_of(person)


def test_the_panels_show_height_provenance_and_counts(person, addon):
    person[MARK] = json.dumps(
        {
            **json.loads(person[MARK]),
            "edits": [{"edit": "vary", "amount": 0.5}],
            "attributes": {"sex": "female", "hair": "bald"},
            "unfollowed": {"hair": "long"},
        }
    )
    addon.scene.unit_settings.system = "IMPERIAL"
    panel = " ".join(shown(PRIMDIFFUSION_PT_shape, addon))
    assert "In the scene: " in panel
    assert "'" in panel
    details = " ".join(shown(PRIMDIFFUSION_PT_advanced, addon, opened=True))
    made = ("Seed: 0", "Steps: 5", "Sex: female", "Not followed: hair (shows long)", "Edit: vary", "amount 0.5")
    for text in (*made, "Volumes: 12", "Files: 0 MB"):
        assert text in details


def test_a_scaled_human_shows_its_height_in_the_scene(person, addon):
    assert "In the scene" not in " ".join(shown(PRIMDIFFUSION_PT_shape, addon))
    armature_of(person).scale = (2, 2, 2)
    addon.view_layer.update()
    tall = 2 * measure(shape_model_of(person), betas_of(person)).height
    assert f"In the scene: {f'{tall:.2f}'.rstrip('0')} m" in " ".join(shown(PRIMDIFFUSION_PT_shape, addon))


def test_other_bodies_have_sliders_with_numbers(person):
    assert slider_names(shape_model_of(person)) == [str(number) for number in range(1, 11)]


def test_the_six_sliders_with_names_are_shown_and_the_others_folded(person, addon, monkeypatch):
    monkeypatch.setattr(shape, "DEFAULT_BODY_VERTICES", len(shape_model_of(person).template))
    drawn: list[tuple[str, str]] = []

    def layout(fold: str) -> MagicMock:
        made = MagicMock()
        made.prop.side_effect = lambda _owner, name, text=None, **_: drawn.append((fold, text or name))
        made.column.side_effect = lambda **_: layout(fold)
        made.panel.side_effect = lambda _idname, default_closed: (
            MagicMock(),
            layout("folded" if default_closed else ""),
        )
        return made

    PRIMDIFFUSION_PT_shape.draw(SimpleNamespace(layout=layout("")), addon)
    named = ["height", "weight", "Stature", "Shoulders", "Waist", "Girth"]
    assert drawn == [("", name) for name in named] + [("folded", number) for number in ("3", "5", "7", "8", "9", "10")]
