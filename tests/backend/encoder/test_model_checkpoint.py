"""The encoder's file: what comes back, and what is rejected."""

import dataclasses
import json

import pytest
import torch
from primdiffusion.encoder.model import EncoderModel, load_encoder, save_encoder
from primdiffusion.encoder.network import Encoder
from primdiffusion.files.regular_files import FileError
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from support.errors import refused
from tiny_encoder import TINY, save_tiny_encoder, tiny_encoder


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    return save_tiny_encoder(tmp_path_factory.mktemp("encoder") / "encoder.safetensors")


def changed(saved, path, tensors=None, **metadata):
    """The same file with other tensors or metadata; None takes an entry away."""
    with safe_open(saved, framework="pt") as file:
        before = file.metadata()
    after = {key: value for key, value in {**before, **metadata}.items() if value is not None}
    save_file(load_file(saved) if tensors is None else tensors, path, metadata=after)
    return path


def test_an_encoder_comes_back_with_its_settings_card_and_weights_to_half_precision(saved):
    back, before = load_encoder(saved), tiny_encoder()
    assert back.config == TINY
    assert back.card == {"name": "tiny encoder"}
    assert not back.encoder.training
    for (name, value), expected in zip(
        back.encoder.state_dict().items(), before.encoder.state_dict().values(), strict=True
    ):
        assert value.dtype == torch.float32, name
        assert torch.equal(value, expected.half().float())
        assert not value.requires_grad


def test_a_missing_file_is_named(tmp_path):
    with refused(FileNotFoundError, "nothing.safetensors"):
        load_encoder(tmp_path / "nothing.safetensors")


@pytest.mark.parametrize(
    "metadata",
    [
        {"format": "pt"},
        {"format_version": "9"},
        {"config": json.dumps({"stem": [2, 2, 4]})},
        {"config": "{"},
        {"config": None},
        {"card": "["},
        {"config": json.dumps(dataclasses.asdict(dataclasses.replace(TINY, fused=8)))},
        {"config": json.dumps(dataclasses.asdict(TINY) | {"stem": 3})},
        {"config": json.dumps(dataclasses.asdict(TINY) | {"attention_blocks": 10**9})},
        {"config": json.dumps(dataclasses.asdict(TINY) | {"fused": 10**6})},
    ],
)
def test_a_file_that_is_something_else_is_rejected_in_one_line(saved, tmp_path, metadata):
    with refused(FileError, str(tmp_path / "other")) as error:
        load_encoder(changed(saved, tmp_path / "other", **metadata))
    assert "\n" not in str(error.value)


def test_weights_that_are_missing_or_not_finite_are_rejected(saved, tmp_path):
    tensors = load_file(saved)
    key = next(iter(tensors))
    with refused(FileError):
        load_encoder(changed(saved, tmp_path / "less", {k: v for k, v in tensors.items() if k != key}))
    with refused(FileError, "NaN"):
        load_encoder(changed(saved, tmp_path / "nan", {**tensors, key: torch.full_like(tensors[key], float("nan"))}))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e6])
def test_weights_that_half_precision_cannot_hold_replace_no_file(saved, tmp_path, bad):
    path = tmp_path / "encoder.safetensors"
    path.write_bytes(saved.read_bytes())
    encoder = Encoder(TINY)
    with torch.no_grad():
        encoder.scale_out.bias[0, 0, 0] = bad
    with refused(FileError, "scale_out.bias"):
        save_encoder(path, EncoderModel(encoder, {}))
    assert path.read_bytes() == saved.read_bytes()
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
