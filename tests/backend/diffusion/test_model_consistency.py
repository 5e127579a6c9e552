"""Checkpoints whose parts do not fit each other are rejected when they are loaded, not when a human is generated."""

import json

import pytest
import torch
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.files.regular_files import FileError
from primdiffusion.files.tensor_file import read, save
from primdiffusion.human import generate
from support.errors import refused
from tiny_model import save_tiny_checkpoint


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    return read(save_tiny_checkpoint(tmp_path_factory.mktemp("whole") / "whole.safetensors"))


def load_with(content, path, **changed):
    tensors, metadata = content
    path.write_bytes(save(tensors | changed, metadata))
    return load_checkpoint(path)


def other_shapes(value):
    """The tensor one shorter and twice as long along each axis, flat, with an axis more, and empty."""
    for axis in range(value.ndim):
        if value.shape[axis] > 1:
            yield value.narrow(axis, 0, value.shape[axis] - 1).contiguous()
        yield torch.cat([value, value], axis)
    yield from (value.flatten()[:1].clone(), value[None].clone(), value.flatten()[:0].clone())


def test_what_loads_generates_and_what_does_not_fit_does_not_load(content, tmp_path):
    rejected = 0
    for name, value in content[0].items():
        for changed in other_shapes(value):
            fewer_channels = name == "denoiser.prior_basis_half" and changed.shape == (3, 3, 32, 16)  # is possible
            if changed.shape == value.shape or fewer_channels:
                continue
            with refused(FileError):
                load_with(content, tmp_path / "a.safetensors", **{name: changed})
            rejected += 1
    assert rejected > 60
    generate(load_with(content, tmp_path / "a.safetensors"), 1, 1)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("denoiser.prior_variance", torch.full((1, 3), -1.0)),
        ("denoiser.prior_basis_half", torch.full((3, 4, 32, 16), 6.0)),
        ("codec.weight", torch.zeros(2051)),
        ("shapes.limit", torch.full((10,), 1e6)),
    ],
)
def test_values_that_make_no_human_are_rejected(content, tmp_path, name, value):
    with refused(FileError):
        load_with(content, tmp_path / "a.safetensors", **{name: value})


def test_a_vocabulary_of_another_width_is_rejected(content, tmp_path):
    tensors, metadata = content
    architecture = json.loads(metadata["architecture"])
    architecture["vocabulary"]["scalars"] = {}
    changed = tensors, metadata | {"architecture": json.dumps(architecture)}
    with refused(FileError, "6 values"):
        load_with(changed, tmp_path / "a.safetensors")
