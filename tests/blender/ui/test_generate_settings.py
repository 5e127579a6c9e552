"""Asking for attributes: menus of what the checkpoint knows, from its header; nothing is asked for unless chosen."""

import json
import os
from pathlib import Path
from unittest.mock import MagicMock

import bpy
import pytest
from blender_primdiffusion.formats.requests import PARTS
from human_files import person_file
from support.errors import refused
from support.fake_child import request_of

from blender_primdiffusion.scene.human import humans
from blender_primdiffusion.ui import edit_panel
from blender_primdiffusion.ui import generate_settings as attributes

pytestmark = pytest.mark.any_blender

VOCABULARY = {
    "categories": {"sex": ["female", "male"], "outfit": ["suit", "fitted tee and jeans"], "age": ["old"]},
    "scalars": {"height": [1.7, 0.1]},
}


def checkpoint(path: Path, vocabulary: dict | None) -> Path:
    """The beginning of a checkpoint's file."""
    architecture = json.dumps({"kind": "person"} | ({"vocabulary": vocabulary} if vocabulary else {}))
    header = json.dumps({"__metadata__": {"architecture": architecture}}).encode()
    path.write_bytes(len(header).to_bytes(8, "little") + header)
    return path


@pytest.fixture
def known(addon, tmp_path, monkeypatch):
    """The add-on with a checkpoint that knows VOCABULARY; the panel's group."""
    path = checkpoint(tmp_path / "knows.safetensors", VOCABULARY)
    monkeypatch.setattr(attributes, "preference", lambda name: str(path) if name == "checkpoint" else "")
    return addon.scene.primdiffusion.attributes


def sent(context) -> dict:
    return request_of(person_file(humans(context.scene)[-1]))


def test_menus_hold_what_the_checkpoint_knows_and_any(known):
    assert [item[0] for item in attributes.menu("sex")] == ["ANY", "female", "male"]
    assert [item[1] for item in attributes.menu("outfit")] == ["Any", "Suit", "Fitted tee and jeans"]
    assert [item[0] for item in attributes.menu("hair")] == ["ANY"]
    known.outfit = "fitted tee and jeans"
    with refused(TypeError, "dress"):
        known.outfit = "dress"


def test_unchosen_attributes_are_not_requested(addon, known):
    bpy.ops.primdiffusion.generate(seed=7)
    assert "attributes" not in sent(addon)
    known.sex, known.use_height, known.height, known.use_weight = "female", True, 1.82, True
    addon.scene.primdiffusion.sampler, addon.scene.primdiffusion.guidance = "dpmpp_2m", 3.0
    bpy.ops.primdiffusion.generate(seed=7)
    asked = sent(addon)
    assert asked["attributes"] == {"sex": "female", "height": 1.82}, "the checkpoint knows no weight"
    assert (asked["guidance"], asked["sampler"]) == (3.0, "dpmpp_2m")


def test_redressing_has_attributes_of_its_own(addon, known):
    bpy.ops.primdiffusion.generate(seed=7)
    known.sex = "female"
    addon.scene.primdiffusion_edit.attributes.outfit = "suit"
    bpy.ops.primdiffusion.redress(seed=8)
    asked = sent(addon)
    assert (asked["attributes"], asked["region"]) == ({"outfit": "suit"}, ["top"])


def test_a_choice_survives_saving_and_is_left_out_with_a_checkpoint_that_does_not_know_it(
    addon, known, tmp_path, monkeypatch
):
    known.outfit = "suit"
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    group = bpy.context.scene.primdiffusion.attributes
    assert attributes.chosen_attributes(group) == {"outfit": "suit"}
    others = {**VOCABULARY, "categories": {"outfit": ["dress", "robe", "suit"]}}
    path = checkpoint(tmp_path / "others.safetensors", others)
    monkeypatch.setattr(attributes, "preference", lambda _: str(path))
    assert attributes.chosen_attributes(group) == {"outfit": "suit"}, "by its name, not by its place"
    checkpoint(path, {**VOCABULARY, "categories": {"outfit": ["robe"]}})
    os.utime(path, (1, 1))
    assert attributes.chosen_attributes(group) == {}


@pytest.mark.parametrize("contents", [None, b"", b"no checkpoint at all"])
def test_a_checkpoint_that_cannot_be_read_or_knows_nothing_leaves_the_menus_empty(
    addon, tmp_path, monkeypatch, contents
):
    path = checkpoint(tmp_path / "plain.safetensors", None)
    if contents is not None:
        path.write_bytes(contents)
    monkeypatch.setattr(attributes, "preference", lambda _: str(path))
    layout = MagicMock()
    attributes.draw_attributes(layout, addon.scene.primdiffusion.attributes)
    assert layout.label.call_args.kwargs["text"] == "This checkpoint has no attributes"
    assert attributes.chosen_attributes(addon.scene.primdiffusion.attributes) == {}


@pytest.mark.parametrize("vocabulary", [{"categories": {"sex": ["x" * 70_000]}}, {"scalars": {"height": [0, -1]}}])
def test_a_checkpoint_that_is_damaged_or_claims_much_is_read_once(known, tmp_path, monkeypatch, vocabulary):
    path, read = checkpoint(tmp_path / "odd.safetensors", vocabulary), []
    monkeypatch.setattr(attributes, "preference", lambda name: str(path) if name == "checkpoint" else "")
    once = attributes.read_vocabulary
    monkeypatch.setattr(attributes, "read_vocabulary", lambda path: read.append(path) or once(path))
    for _ in range(3):
        assert attributes.known() == attributes.Vocabulary()
    assert read == [path]


def test_the_panel_draws_menus_and_numbers_that_the_checkpoint_knows(addon, known):
    layout = MagicMock()
    attributes.draw_attributes(layout, addon.scene.primdiffusion.attributes)
    assert [call.args[1] for call in layout.prop.call_args_list] == ["sex", "outfit"]
    assert layout.row().prop.call_args.args[1] == "use_height"


def test_every_part_of_the_body_can_be_chosen(addon):
    panel = addon.scene.primdiffusion_edit
    panel.parts = set(PARTS)
    assert panel.parts == set(PARTS)
    assert edit_panel.PRIMDIFFUSION_PG_edit.bl_rna.properties["parts"].default_flag == {"top"}
