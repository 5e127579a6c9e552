"""The extension opens .human files by numpy as the backend does."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from export_people import person
from primdiffusion.body.model import default_body as backend_body
from primdiffusion.editing.reshaping import reshape_human as reshape_in_backend
from primdiffusion.files import tensor_file
from primdiffusion.human import Human, generate, place
from primdiffusion.human_file import load_human, save_body, save_human
from primdiffusion.primitives.anchors import default_anchors
from support.errors import refused
from support.tiny import tiny_model

from blender_primdiffusion.scene.human_file import (
    body_arrays,
    default_body,
    expanded,
    read_human,
    read_payload,
    read_tensors,
    reshaped,
    write_tensors,
)


@pytest.fixture(scope="module")
def human() -> Human:
    generator = torch.Generator().manual_seed(3)
    payload = dataclasses.replace(
        person().payload,
        rgb=torch.rand(person().payload.rgb.shape, generator=generator) ** 2,
        density=100 * torch.rand(person().payload.density.shape, generator=generator) ** 4,
        delta_scale=0.8 + 0.4 * torch.rand(person().payload.delta_scale.shape, generator=generator),
    )
    return dataclasses.replace(person(), payload=payload, betas=torch.linspace(-2, 2, 10))


def test_the_default_body_is_the_backends(tmp_path):
    save_body(tmp_path / "body.safetensors", backend_body(), default_anchors())
    wanted = body_arrays(tmp_path / "body.safetensors")
    model = default_body()
    assert {name for name in vars(model) if getattr(model, name) is not None} == set(wanted)
    for name, values in wanted.items():
        assert getattr(model, name).dtype == values.dtype, name
        assert np.allclose(getattr(model, name), values, rtol=0, atol=1e-5), name


def test_a_human_at_rest_is_the_backends_in_the_t_pose(human, tmp_path):
    save_human(tmp_path / "a.human", human)
    found, wanted = read_human(tmp_path / "a.human"), place(human)
    assert np.allclose(found.rest.position, wanted.position, atol=1e-5)
    assert np.allclose(found.rest.rotation, wanted.rotation, atol=1e-4)
    assert np.allclose(found.grids().half_extent, wanted.half_extent, atol=1e-6)


def test_a_compact_file_is_a_quarter_of_the_size_and_the_same_to_both_programs(human, tmp_path):
    plain, compact = (tmp_path / name for name in ("plain.human", "compact.human"))
    save_human(plain, human)
    save_human(compact, human, compact=True)
    assert compact.stat().st_size < 0.26 * plain.stat().st_size
    payload = load_human(compact).payload
    assert np.array_equal(read_payload(compact).rgb, payload.rgb.numpy())
    assert np.array_equal(read_payload(compact).density, payload.density.numpy())
    assert (payload.density.sqrt() - human.payload.density.sqrt()).abs().max() <= 10 / 255
    write_tensors(tmp_path / "again.human", expanded(read_tensors(compact)))
    assert torch.equal(load_human(tmp_path / "again.human").payload.rgb, payload.rgb)


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
        (provenance("[" * 100_000), False),
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


@pytest.fixture
def saved(tmp_path):
    save_human(tmp_path / "a.human", person())
    return tmp_path / "a.human"


def test_a_reshaped_person_in_a_file_is_the_backends_reshaped_person(saved, tmp_path):
    betas = np.linspace(-1.5, 1.5, 10).astype(np.float32)
    kept = reshaped(read_tensors(saved), betas, default_body().growth(person().betas.numpy(), betas))
    write_tensors(tmp_path / "b.human", kept)
    again, wanted = load_human(tmp_path / "b.human"), reshape_in_backend(person(), torch.tensor(betas))
    assert again.betas.equal(wanted.betas)
    assert again.payload.rgb.equal(person().payload.rgb)
    assert again.payload.density.equal(person().payload.density)
    assert dict(again.provenance)["seed"] == 1
    assert torch.allclose(again.payload.delta_scale, wanted.payload.delta_scale, rtol=1e-5)
    assert wanted.payload.delta_scale.max() > 1.05 * person().payload.delta_scale.max()


def test_boxes_of_another_body_are_rejected(saved):
    with refused(ValueError, "[5, 3]", "generate"):
        reshaped(read_tensors(saved), np.zeros(10), np.ones((5, 3)))


def test_a_file_that_cannot_be_finished_leaves_the_old_one(saved, monkeypatch):
    before = saved.read_bytes()
    human = read_tensors(saved)
    human.arrays["zzz"] = ("U8", (1,), None)  # type: ignore[assignment]
    with pytest.raises(TypeError):
        write_tensors(saved, human)
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]
