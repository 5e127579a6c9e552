"""The extension opens .human files by numpy as the backend does."""

import dataclasses

import numpy as np
import pytest
import torch
from export_people import person
from primdiffusion.body.model import default_body as backend_body
from primdiffusion.human import Human, place
from primdiffusion.human_file import load_human, save_body, save_human
from primdiffusion.primitives.anchors import default_anchors

from blender_primdiffusion.scene.human_file import (
    body_arrays,
    default_body,
    expanded,
    read_human,
    read_payload,
    read_tensors,
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
