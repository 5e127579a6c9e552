"""The panel Human: who is meant, and their shape."""

import json
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np
import pytest
import synthetic
import synthetic_shape
from jobs_driven import Layout, shown
from oracle import evaluated_matrices
from pose_assets import pose_from_library
from support.errors import refused

from blender_primdiffusion.scene import shape
from blender_primdiffusion.scene.armature import CONTROLS
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.handles import has_handles
from blender_primdiffusion.scene.human import BETAS, MARK, body_of, humans
from blender_primdiffusion.scene.human_file import shape_model_of
from blender_primdiffusion.scene.shape import betas_of, generated_betas, measure, slider_names
from blender_primdiffusion.ui import human_panel
from blender_primdiffusion.ui.advanced_panel import PRIMDIFFUSION_PT_advanced
from blender_primdiffusion.ui.human_panel import PRIMDIFFUSION_PT_human
from blender_primdiffusion.ui.shape_panel import (
    PRIMDIFFUSION_OT_reshape,
    draw_shape,
)

pytestmark = pytest.mark.any_blender

ops = bpy.ops.primdiffusion
TALL = [2.0] + [0.0] * 9


@pytest.fixture
def person(addon, tmp_path):
    return build_human(addon, synthetic_shape.write(tmp_path / "human"))


@pytest.fixture
def other(person, addon, tmp_path):
    return build_human(addon, synthetic_shape.write(tmp_path / "other", seed=3), "Ötzi")


def settings(person):
    return person.primdiffusion_human


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


def test_one_undo_takes_a_slider_back_and_redo_brings_it_again(person):
    def state():
        """Bones, mesh, volumes and betas."""
        (someone,) = humans(bpy.context.scene)
        heads = [list(bone.head_local) for bone in someone.data.bones]
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
    addon.view_layer.objects.active = person
    bpy.ops.object.mode_set(mode="EDIT")
    before = list(person[BETAS])
    settings(person).betas = TALL
    assert list(person[BETAS]) == before
    assert "Edit Mode: leave it" in " ".join(shown(draw_shape, addon))
    with refused(RuntimeError, "Edit Mode"):
        ops.reshape(to="GENERATED")
    bpy.ops.object.mode_set(mode="OBJECT")


def test_random_shapes_are_those_of_their_seeds_and_reset_brings_back_the_generated_one(person, addon):
    before = surface(person)
    ops.reshape(to="RANDOM", seed=5)
    first = betas_of(person)
    ops.reshape(to="RANDOM", seed=6)
    assert np.abs(betas_of(person) - first).max() > 0.1
    ops.reshape(to="RANDOM", seed=5)
    np.testing.assert_array_equal(betas_of(person), first)
    assert ops.reshape(to="GENERATED") == {"FINISHED"}
    np.testing.assert_allclose(surface(person), before, atol=1e-5)
    pressed = [
        SimpleNamespace(to="RANDOM", seed=0, given=lambda _: False, execute=lambda _: {"FINISHED"}) for _ in range(2)
    ]
    for press in pressed:  # background mode has no window to press a button in
        assert PRIMDIFFUSION_OT_reshape.invoke(press, addon, None) == {"FINISHED"}
    assert pressed[0].seed != pressed[1].seed


def test_the_panel_shows_provenance(person, addon):
    person[MARK] = json.dumps(
        {
            **json.loads(person[MARK]),
            "sampler": "ddim",
            "edits": [{"edit": "vary", "amount": 0.5}],
            "attributes": {"sex": "female", "hair": "bald"},
            "unfollowed": {"hair": "long"},
        }
    )
    details = " ".join(shown(PRIMDIFFUSION_PT_advanced, addon, opened=True))
    made = ("Seed: 0", "Steps: 5", "Sampler: DDIM", "Sex: female", "Not followed: hair (shows long)")
    for text in (*made, "Edit: vary", "amount 0.5"):
        assert text in details


def test_the_six_sliders_with_names_are_shown_and_the_others_folded(person, addon, monkeypatch):
    assert slider_names(shape_model_of(person)) == [str(number) for number in range(1, 11)], "of another body"
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

    draw_shape(layout(""), addon)
    named = ["height", "weight", "Stature", "Shoulders", "Waist", "Girth"]
    assert drawn == [("", name) for name in named] + [("folded", number) for number in ("3", "5", "7", "8", "9", "10")]


def test_the_panel_names_who_is_selected_or_asks(person, other, addon):
    assert "2 humans are in the scene: select" in shown(PRIMDIFFUSION_PT_human, addon)
    addon.view_layer.objects.active = body_of(other)
    layout = Layout()
    PRIMDIFFUSION_PT_human.draw(SimpleNamespace(layout=layout), addon)
    assert layout.of("prop") == ["name"]


EXACT_M = 1e-4


def heads(armature) -> np.ndarray:
    """Joints [24, 3] as they are seen, in the armature's space."""
    bpy.context.view_layer.update()
    return np.array([armature.pose.bones[name].head for name in synthetic.NAMES])


def test_the_panel_leads_to_the_asset_shelf_of_pose_mode(addon, armature):
    addon.view_layer.objects.active = armature
    for button, other in (
        ("object.posemode_toggle", "show_region_asset_shelf"),
        ("show_region_asset_shelf", "object.posemode_toggle"),
    ):
        layout = Layout()
        human_panel.draw_pose(layout, addon)
        assert button in layout.of("button", "prop")
        assert other not in layout.of("button", "prop")
        bpy.ops.object.posemode_toggle()


def test_the_panel_offers_to_add_handles_or_else_to_bake_them(addon, armature):
    drawn = set(shown(human_panel.draw_pose, addon))
    assert "primdiffusion.add_handles" in drawn
    assert "primdiffusion.bake_handles" not in drawn
    ops.add_motion(motion="WAVE", rounds=1)
    action = armature.animation_data.action
    assert ops.add_handles() == {"FINISHED"}
    with refused(RuntimeError, "has IK handles"):
        ops.add_motion(motion="WALK")
    assert armature.animation_data.action == action
    drawn = set(shown(human_panel.draw_pose, addon))
    assert "primdiffusion.bake_handles" in drawn
    assert "primdiffusion.add_handles" not in drawn
    assert ops.bake_handles() == {"FINISHED"}
    assert not has_handles(armature)
    with refused(RuntimeError, "no IK handles"):
        ops.bake_handles()
    assert ops.add_motion(motion="WALK") == {"FINISHED"}


def test_undo_takes_handles_away_and_brings_them_back(addon, armature):
    pose_from_library(armature, "Walking")
    bpy.ops.ed.undo_push(message="before")
    ops.add_handles()
    bpy.ops.ed.undo_push(message="handles")
    before = heads(armature)
    ops.bake_handles()
    bpy.ops.ed.undo_push(message="baked")
    bpy.ops.ed.undo()
    again = bpy.data.objects["Ann"]
    assert all(name in again.data.bones for name in CONTROLS)
    np.testing.assert_allclose(heads(again), before, atol=EXACT_M)
    bpy.ops.ed.undo()
    assert not has_handles(bpy.data.objects["Ann"])
