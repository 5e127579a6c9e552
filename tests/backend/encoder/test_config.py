"""Named settings of the encoder, and their way through JSON."""

import dataclasses
import json

import pytest
from primdiffusion.encoder.config import PRESETS, config_from_json
from support.errors import refused
from tiny_encoder import TINY


@pytest.mark.parametrize("preset", PRESETS)
def test_configurations_come_back_from_json(preset):
    config = PRESETS[preset]
    assert config_from_json(json.loads(json.dumps(dataclasses.asdict(config)))) == config


def test_unknown_and_missing_settings_are_rejected_by_name():
    tree = dataclasses.asdict(TINY)
    with refused(ValueError, "colour_of_eyes"):
        config_from_json({**tree, "colour_of_eyes": "blue"})
    with refused(ValueError, "differs"):
        config_from_json({name: value for name, value in tree.items() if name != "motion"})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"appearance": "pixels"}, "appearance is 'pixels': choose one of 'voxels', 'texels'"),
        ({"attention": "some"}, "attention is 'some'"),
        ({"grid": ()}, "0 levels: give 1 to 6"),
        ({"grid": (8,) * 7}, "7 levels"),
        ({"attention_width": 6, "attention_heads": 4}, "attention_width 6"),
        ({"scale_outputs": 2}, "3 numbers"),
    ],
)
def test_impossible_settings_are_rejected(settings, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(TINY, **settings)


def test_each_ablation_differs_from_the_default_in_one_setting():
    default = dataclasses.asdict(PRESETS["default"])
    for preset in ("shared_scale", "template_rt", "no_attention"):
        changed = [name for name, value in dataclasses.asdict(PRESETS[preset]).items() if default[name] != value]
        assert len(changed) == 1, preset
