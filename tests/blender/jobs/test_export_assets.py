"""People as assets: marked with words and a picture, brought into other files with everything they need."""

import json
from unittest.mock import MagicMock

import bpy
import numpy as np
import pytest
from human_files import lose_data, person_file
from PIL import Image
from support.errors import refused
from support.fake_child import PICTURE

from blender_primdiffusion.scene.human import MARK, humans
from blender_primdiffusion.ui import export_panel

ops = bpy.ops.primdiffusion


@pytest.fixture
def person(addon):
    ops.generate(seed=7)
    (person,) = humans(addon.scene)
    made = json.loads(person[MARK])
    person[MARK] = json.dumps({**made, "attributes": {"sex": "female", "height": 1.7}})
    return person


def preview(asset: bpy.types.ID) -> np.ndarray:
    """Bottom row first, 0 to 255."""
    width, height = asset.preview.image_size
    pixels = np.empty(width * height * 4, np.float32)
    asset.preview.image_pixels_float.foreach_get(pixels)
    return pixels.reshape(height, width, 4) * 255


def rendered(tmp_path) -> dict:
    return json.loads((tmp_path / "prepared" / "rendered.json").read_text())


def test_a_human_becomes_an_asset_with_tags_and_a_preview(person, tmp_path):
    assert ops.mark_as_asset() == {"FINISHED"}
    about = person.asset_data
    assert about.description == "Generated human, seed 0, sex female, height 1.7"
    assert {tag.name for tag in about.tags} == {"human", "female"}
    assert about.author == ""
    drawn = np.array(Image.open(PICTURE).convert("RGBA"))[::-1]
    np.testing.assert_allclose(preview(person), drawn, atol=2)
    asked = rendered(tmp_path)
    assert asked["human"] == str(person_file(person))
    assert (len(asked["pose"]), asked["pose"][16 * 3 + 2]) == (72, -1.15)


def test_one_undo_makes_it_an_ordinary_armature_again(person):
    bpy.ops.ed.undo_push(message="before")
    ops.mark_as_asset(human="Human")
    bpy.ops.ed.undo()
    assert humans(bpy.context.scene)[0].asset_data is None
    bpy.ops.ed.redo()
    assert humans(bpy.context.scene)[0].asset_data is not None


@pytest.mark.any_blender
def test_unmarking_leaves_the_person(person):
    ops.mark_as_asset()
    with bpy.context.temp_override(id=person):  # as the panel's button
        assert bpy.ops.asset.clear_single() == {"FINISHED"}
    assert person.asset_data is None
    assert humans(bpy.context.scene) == [person]


@pytest.mark.any_blender
def test_what_cannot_be_an_asset_is_reported(addon):
    with refused(RuntimeError, "human"):
        ops.mark_as_asset()
    ops.generate(seed=7)
    with refused(RuntimeError, "Eve"):
        ops.mark_as_asset(human="Eve")
    (person,) = humans(addon.scene)
    assert person.asset_data is None
    lose_data(person)
    with refused(RuntimeError, "Human"):
        ops.mark_as_asset()
    assert person.asset_data is None


@pytest.mark.any_blender
def test_the_panel_offers_what_makes_sense(person):
    def buttons() -> list[str]:
        layout = MagicMock()
        layout.row.return_value = layout
        export_panel._draw_assets(layout, bpy.context)
        if layout.context_pointer_set.called:
            layout.context_pointer_set.assert_called_once_with("id", person)
        return [call.args[0] for call in layout.operator.call_args_list]

    assert buttons() == ["primdiffusion.mark_as_asset"]
    ops.mark_as_asset()
    assert buttons() == ["asset.clear_single"]
