"""Editing the selected person as the user meets it, with the real client and a child that can be told to misbehave."""

import json
from pathlib import Path

import bpy
import numpy as np
import pytest
import synthetic
import synthetic_shape
from human_files import paths_of, person_file
from jobs_driven import drive, notice_of, shown, until_running
from support.errors import refused
from support.fake_child import TAKES_LONG, request_of
from support.tensor_files import read_tensors

from blender_primdiffusion.jobs.generate import EditJob
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.convention import points_to_blender
from blender_primdiffusion.scene.human import body_of, humans, parts_of
from blender_primdiffusion.ui import edit_panel

FINE = 8
"""A seed that is no order to the fake child."""
COUNT = 8
"""Primitives of the synthetic people."""
ops = bpy.ops.primdiffusion
pytestmark = pytest.mark.any_blender


@pytest.fixture
def person(addon, tmp_path, monkeypatch):
    """Somebody at work on whom there is to edit, and somebody else, in a saved file."""
    file = synthetic_shape.write(tmp_path / "prepared", COUNT)
    monkeypatch.setenv("FAKE_HUMAN", str(file))
    first, _ = build_human(addon, file), build_human(addon, file)
    addon.view_layer.objects.active = first
    bpy.ops.ed.undo_push(message="two people")
    return first


def settings():
    """Of the panel."""
    return bpy.context.scene.primdiffusion_edit


def sent(person) -> dict:
    """What the child was asked, but for the folder of the job."""
    asked = request_of(person_file(person))
    del asked["out_dir"], asked["size"], asked["picture_px"]
    return asked


def start(person, seed: int = FINE, **params) -> None:
    queue.add(bpy.context, EditJob.of("vary", person, {"steps": 2, "amount": 0.5, "seed": seed, **params}))


def drawn(kind: str) -> str:
    """The panel, with this edit chosen."""
    settings().kind = kind
    return " | ".join(shown(edit_panel.draw_edit, bpy.context))


def test_vary_changes_the_selected_person_in_place_as_one_undo_step(person):
    first, before = person_file(person), paths_of(person)
    person.location.x = 3.0
    bpy.ops.ed.undo_push(message="moved")
    settings().amount, bpy.context.scene.primdiffusion.steps = 0.25, 3
    assert ops.vary(seed=FINE) == {"FINISHED"}
    assert sent(person) == {"person": str(first), "amount": 0.25, "seed": FINE, "steps": 3}
    assert not set(before) & set(paths_of(person))
    assert person.location.x == 3.0
    assert notice_of("vary").startswith("Varied Human in ")
    after = paths_of(person)
    bpy.ops.ed.undo()
    person = humans(bpy.context.scene)[0]
    assert paths_of(person) == before
    assert person_file(person) == first
    assert person.location.x == 3.0
    bpy.ops.ed.redo()
    assert paths_of(humans(bpy.context.scene)[0]) == after
    assert not list(Path(bpy.app.tempdir).glob("vary_*"))


def test_redress_changes_the_primitives_of_the_region_alone(person):
    before, other = read_tensors(person_file(person))[0], paths_of(humans(bpy.context.scene)[1])
    settings().parts, settings().attributes.outfit = {"top", "left_foot"}, "suit"
    assert ops.redress(seed=FINE) == {"FINISHED"}
    asked = sent(person)
    assert asked["region"] == ["left_foot", "top"]
    assert (asked["attributes"], asked["guidance"]) == ({"outfit": "suit"}, 2.0)
    after = read_tensors(person_file(person))[0]
    assert [k for k in range(COUNT) if (after["rgb"][k] != before["rgb"][k]).any()] == [1, 2]
    assert paths_of(humans(bpy.context.scene)[1]) == other


def test_a_script_sets_what_the_panel_shows(person):
    panel = settings()
    panel.seed, panel.parts, panel.harmonise = FINE, {"hair", "face"}, 0.5
    panel.what, panel.other = "garment", humans(bpy.context.scene)[1]
    bpy.context.scene.primdiffusion.steps = 2
    ops.transfer_texture()
    source = person_file(panel.other)
    asked = sent(person)
    del asked["person"]
    where = {"source": str(source), "region": ["face", "hair"], "what": "garment"}
    assert asked == {**where, "harmonise": 0.5, "seed": FINE, "steps": 2}


def test_a_blend_moves_the_body_where_the_betas_differ(person):
    betas = read_tensors(person_file(person))[0]["betas"].astype(np.float64)
    settings().other, settings().fraction = humans(bpy.context.scene)[1], 0.75
    for obj in list(parts_of(person)):
        obj.lock_location = obj.lock_rotation = obj.lock_scale = (True, True, True)
        obj.hide_select = obj.hide_viewport = True
    assert ops.blend(human="Human") == {"FINISHED"}, "locked and hidden, too"
    asked = sent(person)
    assert (asked["other"], asked["fraction"]) == (str(person_file(humans(bpy.context.scene)[1])), 0.75)
    heads = np.array([person.data.bones[name].head_local for name in synthetic.NAMES])
    wanted = points_to_blender(synthetic_shape.at(synthetic_shape.arrays(COUNT), betas + 1)["joints"])
    np.testing.assert_allclose(heads - heads[0], wanted - wanted[0], atol=1e-5)
    assert "the body's shape has changed too" in notice_of("interpolate")


def test_any_part_of_a_person_selects_it_and_a_script_may_name_it(person):
    other = humans(bpy.context.scene)[1]
    before = paths_of(person)
    bpy.context.view_layer.objects.active = body_of(other)
    ops.vary(seed=FINE)
    assert paths_of(person) == before
    assert sent(other)["seed"] == FINE
    ops.vary(human="Human", seed=FINE + 1)
    assert sent(person)["seed"] == FINE + 1
    edited = person_file(person)
    ops.vary(human="Human", seed=FINE)
    assert sent(person)["person"] == str(edited), "an edit of an edit starts from the edited person"


def test_a_painted_region_travels_as_weights_of_all_vertices(person):
    body = body_of(person)
    settings().region, settings().vertex_group = "PAINTED", "sleeve"
    with refused(RuntimeError, "sleeve"):
        ops.redress(seed=FINE)
    settings().property_unset("vertex_group")
    assert ops.paint_region() == {"FINISHED"}
    assert (body.mode, bpy.context.object, body.hide_viewport) == ("WEIGHT_PAINT", body, False)
    assert settings().region == "PAINTED"
    with refused(RuntimeError, "PrimDiffusion Region"):
        ops.redress(seed=FINE)
    body.vertex_groups["PrimDiffusion Region"].add([3, 5], 0.75, "REPLACE")
    assert ops.redress(seed=FINE) == {"FINISHED"}
    painted = np.array(json.loads(person["primdiffusion_human"])["painted"])
    assert painted.shape == (len(body.data.vertices),)
    assert np.flatnonzero(painted).tolist() == [3, 5]
    assert painted[3] == pytest.approx(0.75)
    assert body.mode == "WEIGHT_PAINT"
    assert ops.paint_region(finish=True) == {"FINISHED"}
    assert (body.mode, body.hide_viewport) == ("OBJECT", True)
    with refused(RuntimeError, "painted"):
        ops.paint_region(finish=True)


def test_a_human_that_cannot_be_edited_is_reported_before_a_job_begins(person, addon):
    addon.view_layer.objects.active = None
    settings().parts = set()
    rejected = {
        "select the one you mean": lambda: ops.vary(),
        "'Eve' is not in the scene: choose from 'Human', 'Human.001'": lambda: ops.vary(human="Eve"),
        "Choose the other human in the panel first": lambda: ops.blend(human="Human"),
        "No part of the body is chosen": lambda: ops.redress(human="Human"),
    }
    for sentence, edit in rejected.items():
        with refused(RuntimeError, sentence):
            edit()
        assert not queue.busy
    settings().other = humans(addon.scene)[0]
    with refused(RuntimeError, "'Human' cannot be the other human too"):
        ops.blend(human="Human")
    bpy.data.batch_remove(list(bpy.data.objects))
    assert not ops.vary.poll()


def test_each_edit_shows_only_its_own_job_and_cancels_it(person):
    start(person, TAKES_LONG)
    until_running()
    shown_by_vary = drawn("VARY")
    assert "primdiffusion.cancel" in shown_by_vary
    assert "step" in shown_by_vary
    assert "primdiffusion.cancel" not in drawn("REDRESS")
    ops.cancel()
    drive()
    assert notice_of("vary") == "Cancelled"


def test_the_panel_offers_the_chosen_edit_alone(person):
    offered = {"VARY": "vary", "REDRESS": "redress", "TRANSFER": "transfer_texture", "BLEND": "blend"}
    for kind in offered:
        shown = drawn(kind)
        assert [other for other, name in offered.items() if f"primdiffusion.{name}" in shown] == [kind]
    settings().region = "PAINTED"
    assert "primdiffusion.paint_region" in drawn("REDRESS")
