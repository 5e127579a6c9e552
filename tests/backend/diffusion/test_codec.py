import dataclasses

import numpy as np
import pytest
import torch
from primdiffusion.diffusion.codec import (
    HAZE,
    SCALE_VALUE,
    SLAB_UNIT,
    VALUES,
    cells_from_payload,
    cells_from_voxels,
    fit_codec,
    mirror_cells,
    payload_from_cells,
)
from primdiffusion.primitives.anchors import CHARTS, attach, default_anchors
from primdiffusion.primitives.primitives import GRID, K, Payload, S, pack
from support.errors import refused

MIRROR_X = torch.tensor([-1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def cells():
    generator = torch.Generator().manual_seed(0)
    ramp = torch.linspace(0, 1, S)
    colour = torch.rand(6, K, 3, 1, 1, 1, generator=generator) * torch.ones(S, S, S)
    tilt = torch.rand(6, K, 1, 1, 1, 1, generator=generator) * ramp
    density = (ramp[:, None, None] * torch.ones(S, S, S)).expand(6, K, 1, S, S, S)
    voxels = torch.cat([(colour + 0.3 * tilt).clamp(0, 1), density], 2).flatten(2)
    scale = 1 + 0.1 * torch.rand(6, K, 3, generator=generator)
    return torch.cat([voxels, scale * SCALE_VALUE], 2)


@pytest.fixture(scope="module")
def codec(cells):
    return fit_codec(cells, channels=16, generator=torch.Generator().manual_seed(1))


def test_the_basis_is_orthonormal(codec):
    for basis in codec.basis:
        assert torch.allclose(basis @ basis.T, torch.eye(16), atol=1e-5)


def test_each_region_of_the_body_has_a_basis_that_its_mirror_image_shares(codec):
    names = np.array(CHARTS)[default_anchors().chart]
    parts = np.char.replace(np.char.replace(names, "left_", ""), "right_", "")
    assert len(codec.basis) == len(set(parts)) == 6
    for part in set(parts):
        assert len(set(codec.region[torch.from_numpy(parts == part)].tolist())) == 1
    assert torch.equal(codec.region.unflatten(0, (GRID, GRID)).flip(1).flatten(), codec.region)


def test_the_voxel_basis_is_what_decoding_adds(codec):
    latents = torch.randn(16, GRID, GRID, generator=torch.Generator().manual_seed(4))
    latents[5:] = 0
    added = (codec.decode(latents) - codec.decode(torch.zeros_like(latents)))[:, : 4 * S**3].unflatten(1, (4, -1)).mT
    basis = codec.voxel_basis(5)[codec.region]
    assert torch.allclose(torch.einsum("kvxc,ck->kvx", basis, latents[:5].flatten(1)), added, atol=1e-4)


def test_slopes_on_cells_become_those_on_latents(codec):
    assert codec.weight.unique().numel() > 1
    latents = torch.zeros(codec.channels, GRID, GRID, requires_grad=True)
    slopes = torch.zeros(K, VALUES)
    slopes[::100] = torch.rand(slopes[::100].shape, generator=torch.Generator().manual_seed(2))
    (wanted,) = torch.autograd.grad((codec.decode(latents) * slopes).sum(), latents)
    torch.testing.assert_close(codec.pulled_back(slopes), wanted, rtol=1e-4, atol=1e-4)


def test_what_the_basis_spans_survives_the_round_trip(codec):
    latents = torch.randn(2, 16, GRID, GRID, generator=torch.Generator().manual_seed(3))
    assert torch.allclose(codec.encode(codec.decode(latents)), latents, atol=1e-4)


def test_smooth_people_are_kept_by_few_channels(codec, cells):
    lost = (codec.decode(codec.encode(cells)) - cells).square().mean() / (cells - codec.mean).square().mean()
    assert lost < 1e-3


def test_latents_are_in_the_units_of_the_slab(codec, cells):
    cells = cells.clone()
    # a change of colours and delta scales moves latents as far as it moves the slab, if the basis holds all of it
    cells[:, :, 3 * S**3 : 4 * S**3] = cells[:1, :, 3 * S**3 : 4 * S**3]
    payloads = [payload_from_cells(person, 100.0) for person in cells[:2]]
    slabs = [pack(payload, 100.0) for payload in payloads]
    again = torch.stack([cells_from_payload(payload, 100.0) for payload in payloads])
    latents = codec.encode(again)
    moved = (slabs[0] - slabs[1]).square().sum().sqrt()
    difference = SLAB_UNIT * (again[0] - again[1])
    assert difference.norm().item() == pytest.approx(moved.item(), rel=0.01)
    weighted = (codec.weight * difference).norm().item()
    assert (latents[0] - latents[1]).norm().item() == pytest.approx(weighted, rel=0.01)
    assert pytest.approx(0.364) == SLAB_UNIT


def test_a_delta_scale_moves_cells_as_far_as_the_slab_that_repeats_it():
    one = Payload(torch.rand(K, 3, S, S, S), torch.full((K, S, S, S), 50.0), torch.ones(K, 3))
    other = dataclasses.replace(one, delta_scale=0.5 + torch.rand(K, 3))
    cells = (cells_from_payload(one, 100.0) - cells_from_payload(other, 100.0)).norm() * SLAB_UNIT
    assert cells.item() == pytest.approx((pack(one, 100.0) - pack(other, 100.0)).norm().item(), rel=1e-3)


def test_mirroring_latents_mirrors_cells(codec):
    latents = torch.randn(1, 16, GRID, GRID, generator=torch.Generator().manual_seed(4))
    assert torch.allclose(codec.decode(codec.mirror(latents)), mirror_cells(codec.decode(latents)), atol=1e-4)
    assert torch.equal(codec.mirror(codec.mirror(latents)), latents)
    assert set(codec.parity.flatten().tolist()) == {1.0, -1.0}


def test_mirrored_cells_lie_where_the_default_layout_mirrors_them(default_body):
    # cell (row, column) and (row, 31 - column) are mirror images, with T reversed and B and N mirrored
    frames = attach(default_anchors(), default_body.template, default_body.faces)
    position = frames.position.unflatten(0, (GRID, GRID))
    assert ((position.flip(1) * MIRROR_X) - position).norm(dim=-1).max() < 2e-3
    rotation = frames.rotation.unflatten(0, (GRID, GRID))
    expected = rotation.flip(1) * MIRROR_X[:, None] * torch.tensor([-1.0, 1.0, 1.0])
    cosine = (expected * rotation).sum(-2)
    assert cosine.min() > 0.98


@pytest.fixture(scope="module")
def default_body():
    from primdiffusion.body.model import default_body

    return default_body()


def test_voxels_become_cells_in_the_payload_s_order():
    voxels = torch.zeros(K, S, S, S, 4, dtype=torch.uint8)
    voxels[5, 1, 2, 3] = torch.tensor([255, 0, 51, 204], dtype=torch.uint8)
    cells = cells_from_voxels(voxels)
    values = cells[:, : 4 * S**3].unflatten(-1, (4, S, S, S))[5, :, 1, 2, 3]
    assert torch.allclose(values, torch.tensor([1.0, 0.0, 0.2, 0.8]))
    assert (cells[:, 4 * S**3 :] == SCALE_VALUE).all()


def test_cells_of_a_payload_are_what_it_is_decoded_from():
    density = (120 * torch.rand(K, S, S, S) - 10).clamp(0, 100)  # empty and full voxels too
    payload = Payload(torch.rand(K, 3, S, S, S), density, 0.5 + torch.rand(K, 3))
    again = payload_from_cells(cells_from_payload(payload, 100.0), 100.0)
    assert torch.allclose(again.rgb, payload.rgb, atol=1e-4)
    assert torch.allclose(again.density, payload.density, atol=1e-3)
    assert torch.allclose(again.delta_scale, payload.delta_scale, atol=1e-5)


def test_haze_without_a_dense_neighbour_becomes_empty():
    density = 0.3 * torch.rand(K, S, S, S) ** 3
    payload = Payload(torch.rand(K, 3, S, S, S), density, torch.ones(K, 3))
    decoded = payload_from_cells(cells_from_payload(payload, 1.0, (0.0, 1.0)), 1.0, (0.0, 1.0)).density
    padded = torch.nn.functional.pad(density, (1,) * 6)
    steps = range(3)
    densest = torch.stack(
        [padded[:, a : a + S, b : b + S, c : c + S] for a in steps for b in steps for c in steps]
    ).amax(0)
    first, second = HAZE
    assert (decoded[densest <= first] == 0).all()
    assert torch.allclose(decoded[densest >= second], density[densest >= second], atol=1e-6)
    between = (densest > first) & (densest < second)
    assert between.any()
    assert (decoded[between] < density[between]).all()


def test_decoded_payloads_are_clamped_and_their_haze_removed():
    cells = torch.full((K, VALUES), 3.0)
    cells[:, 3 * S**3 : 4 * S**3] = 0.07
    payload = payload_from_cells(cells, 100.0).validate()
    assert payload.rgb.max() == 1
    assert payload.density.max() == 0
    assert payload_from_cells(-cells, 100.0).rgb.min() == 0
    assert payload_from_cells(-cells, 100.0).delta_scale.min() == 0


def test_too_few_people_are_rejected(cells):
    with refused(ValueError, "components"):
        fit_codec(cells[:0], channels=16, generator=torch.Generator())
