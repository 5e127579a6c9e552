"""Named settings of the encoder, and their way through JSON."""

import dataclasses
import json

import pytest
from primdiffusion.encoder.config import PRESETS, config_from_json, encoder_config
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
    "settings",
    [
        {"appearance": "pixels"},
        {"attention": "some"},
        {"grid": ()},
        {"grid": (8,) * 7},
        {"attention_width": 6, "attention_heads": 4},
        {"attention_blocks": 17},
        {"scale_outputs": 2},
    ],
)
def test_impossible_settings_are_rejected(settings):
    ((name, value), *_) = settings.items()
    with refused(ValueError, name, str(list(value) if isinstance(value, tuple) else value)):
        dataclasses.replace(TINY, **settings)
    with refused(ValueError, next(iter(settings))):
        config_from_json({**dataclasses.asdict(TINY), **settings})


def test_each_ablation_differs_from_the_default_in_one_thing():
    default = dataclasses.asdict(PRESETS["default"])
    one_size = {"delta_scale", "thickness", "extent"}
    for ablation, ablated in (("shared_scale", one_size), ("template_rt", {"frames"}), ("no_attention", {"attention"})):
        config = dataclasses.asdict(encoder_config("default", ablation))
        changed = {name for name, value in config.items() if default[name] != value}
        assert changed == ablated
