"""Both programs' readers of .human files accept the same files."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from primdiffusion.files import tensor_file
from primdiffusion.human import generate
from primdiffusion.human_file import load_human, save_human
from support.errors import refused
from tiny_model import tiny_model

from blender_primdiffusion.scene.rest_human import read_human

Tensors = dict[str, torch.Tensor]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("human") / "a.human"
    save_human(path, generate(tiny_model(), seed=3, steps=2))
    return path


def version(text: str) -> Callable[[Tensors, dict[str, str]], object]:
    return lambda _, metadata: metadata.update(format_version=text)


def provenance(text: str) -> Callable[[Tensors, dict[str, str]], object]:
    return lambda _, metadata: metadata.update(provenance=text)


@pytest.mark.parametrize(
    ("change", "is_read"),
    [
        (version("01"), True),
        (version("4"), False),
        (version(""), False),
        (provenance('{"seed": "seven"}'), False),
        (provenance('{"unknown": NaN}'), False),
        (provenance(json.dumps("\0")), False),
        (lambda _, metadata: metadata.update(compact="{}"), False),
        (lambda tensors, _: tensors.update(rgb=tensors["rgb"].bfloat16()), True),
        (lambda tensors, _: tensors.update(unknown=torch.full((2,), torch.nan)), True),
        (lambda tensors, _: tensors.update(rest_half_extent=torch.ones(3)), False),
        (lambda tensors, _: tensors.update(rest_half_extent=torch.full((1024, 3), 1e6)), False),
        (lambda tensors, _: tensors.update(betas=torch.full((10,), 5.5)), False),
        (lambda tensors, _: tensors.pop("density"), False),
        (lambda tensors, _: tensors.update(density=tensors["density"][:512]), False),
        (lambda tensors, _: tensors.update(density=tensors["density"].reshape(512, 2, 8, 8, 8)), False),
        (lambda tensors, _: tensors.update(density=tensors["density"].int()), False),
        (lambda tensors, _: tensors["density"].view(-1)[:1].fill_(torch.nan), False),
    ],
)
def test_both_readers_give_one_verdict(whole, tmp_path, change, is_read):
    tensors, metadata = tensor_file.read(whole)
    change(tensors, metadata)
    path = tmp_path / "a.human"
    path.write_bytes(tensor_file.save(tensors, metadata))
    for read in (read_human, load_human):
        with contextlib.nullcontext() if is_read else refused(ValueError, "a.human"):
            read(path)
