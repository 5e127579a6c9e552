import dataclasses

import pytest
import torch
from primdiffusion.diffusion.detail import FAINT, SOLID, without_haze
from primdiffusion.primitives.primitives import K, Payload, S

FULL = 50.0


@pytest.fixture
def empty():
    return Payload(torch.rand(K, 3, S, S, S), torch.zeros(K, S, S, S), torch.ones(K, 3))


def with_voxels(payload, **voxels):
    density = payload.density.clone()
    for place, value in voxels.items():
        density[(3, *map(int, place[1:]))] = value * FULL
    return dataclasses.replace(payload, density=density)


def test_faint_voxels_vanish_alone_and_stay_beside_dense_ones(empty):
    alone = with_voxels(empty, v222=0.9 * FAINT)
    assert without_haze(alone, FULL).density.max() == 0
    beside = with_voxels(empty, v222=0.9 * FAINT, v333=SOLID)
    assert torch.equal(without_haze(beside, FULL).density, beside.density)
    beyond = with_voxels(empty, v222=0.9 * FAINT, v224=1.0)
    assert torch.equal(without_haze(beyond, FULL).density, with_voxels(empty, v224=1.0).density)


def test_density_changes_without_a_jump(empty):
    levels = torch.linspace(0, 1, 201)
    kept = torch.stack([without_haze(with_voxels(empty, v222=float(level)), FULL).density.max() for level in levels])
    assert (kept.diff() >= 0).all()
    assert kept.diff().max() < 0.03 * FULL
    assert kept[-1] == FULL


def test_a_batch_is_each_of_its_humans_and_colours_stay(empty):
    dense = dataclasses.replace(empty, density=FULL * torch.rand(K, S, S, S) ** 4)
    both = Payload(
        *(torch.stack([getattr(empty, name), getattr(dense, name)]) for name in ("rgb", "density", "delta_scale"))
    )
    out = without_haze(both, FULL)
    assert torch.equal(out.density[1], without_haze(dense, FULL).density)
    assert torch.equal(out.rgb, both.rgb)
