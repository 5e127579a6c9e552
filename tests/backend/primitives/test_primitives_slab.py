"""The slab layout of SPEC 3: places by hand, exact round trips, clamping."""

import dataclasses
import inspect

import pytest
import torch
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.primitives.primitives import RELEASED_FULL_DENSITY, Payload, pack, unpack
from support.errors import refused

FULL_DENSITY = 100.0


def random_payload(*batch: int, dtype: torch.dtype = torch.float64) -> Payload:
    generator = torch.Generator().manual_seed(3)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand((*batch, *shape), generator=generator, dtype=torch.float64).to(dtype)

    return Payload(uniform(1024, 3, 8, 8, 8), FULL_DENSITY * uniform(1024, 8, 8, 8), 0.2 + 3 * uniform(1024, 3))


def network_value(v: float) -> float:
    return (v / 255 * 2 - 1) * 0.182


@pytest.mark.parametrize("batch", [(), (2,), (2, 1)])
def test_the_round_trip_is_exact(batch):
    payload = random_payload(*batch)
    slab = pack(payload, FULL_DENSITY)
    assert slab.shape == (*batch, 56, 256, 256)
    back = unpack(slab, FULL_DENSITY)
    torch.testing.assert_close(back.rgb, payload.rgb, atol=1e-14, rtol=0)
    torch.testing.assert_close(back.density, payload.density, atol=1e-12, rtol=0)
    torch.testing.assert_close(back.delta_scale, payload.delta_scale, atol=1e-13, rtol=0)


def test_the_round_trip_holds_in_single_precision():
    payload = random_payload(dtype=torch.float32)
    back = unpack(pack(payload, FULL_DENSITY), FULL_DENSITY)
    torch.testing.assert_close(back.rgb, payload.rgb, atol=2e-6, rtol=0)
    torch.testing.assert_close(back.density / FULL_DENSITY, payload.density / FULL_DENSITY, atol=1e-6, rtol=0)
    torch.testing.assert_close(back.delta_scale, payload.delta_scale, atol=1e-5, rtol=0)


def test_packing_what_was_unpacked_gives_the_same_slab():
    slab = pack(random_payload(), FULL_DENSITY)
    torch.testing.assert_close(pack(unpack(slab, FULL_DENSITY), FULL_DENSITY), slab, atol=1e-14, rtol=0)


def test_one_voxel_lands_where_the_layout_says():
    """Voxel (d, h, w) = (5, 2, 6) of primitive 101 = row 3, column 5 of the grid, by hand."""
    zero = Payload(torch.zeros(1024, 3, 8, 8, 8), torch.zeros(1024, 8, 8, 8), torch.zeros(1024, 3))
    zero = zero.to(dtype=torch.float64)
    zero.rgb[101, 1, 5, 2, 6] = 0.5  # encodes to 0.735357
    zero.density[101, 5, 2, 6] = 25.0
    slab = pack(zero, FULL_DENSITY)
    row, column = 3 * 8 + 2, 5 * 8 + 6
    assert slab[5 * 7 + 1, row, column].item() == pytest.approx(network_value(0.735357 * 255), abs=1e-6)
    assert slab[5 * 7 + 3, row, column].item() == pytest.approx(network_value(0.25 * 255))
    touched = (slab != network_value(0)).nonzero().tolist()
    assert touched == [[36, row, column], [38, row, column]]


def test_delta_scale_fills_the_last_three_channels_of_every_layer_of_its_primitive():
    flat = Payload(torch.zeros(1024, 3, 8, 8, 8), torch.zeros(1024, 8, 8, 8), torch.zeros(1024, 3))
    flat.delta_scale[33] = torch.tensor([1.0, 2.0, 4.0])  # row 1, column 1
    slab = pack(flat, FULL_DENSITY)[:, 8:16, 8:16].unflatten(0, (8, 7))
    for channel, scale in ((4, 1.0), (5, 2.0), (6, 4.0)):
        expected = torch.full((8, 8, 8), network_value(scale * 12.75))
        torch.testing.assert_close(slab[:, channel], expected)


def test_the_delta_scale_read_back_is_the_mean_over_the_voxels():
    slab = pack(random_payload(), FULL_DENSITY)
    channel = slab[4, 8:16, 0:8]  # layer 0, tangent axis, primitive 32
    channel += torch.linspace(-0.01, 0.03, 64, dtype=slab.dtype).reshape(8, 8)
    moved = unpack(slab, FULL_DENSITY).delta_scale[32] - random_payload().delta_scale[32]
    expected = 0.01 / 8 / 0.182 / 2 * 20  # mean shift of one layer of eight, in units of delta scale
    torch.testing.assert_close(moved, torch.tensor([expected, 0, 0], dtype=slab.dtype), atol=1e-12, rtol=0)


def test_full_density_is_the_density_stored_as_255():
    payload = random_payload()
    payload = dataclasses.replace(payload, density=torch.full_like(payload.density, RELEASED_FULL_DENSITY))
    slab = pack(payload, RELEASED_FULL_DENSITY)
    torch.testing.assert_close(slab[3], torch.full_like(slab[3], 0.182))
    torch.testing.assert_close(unpack(slab, 2 * RELEASED_FULL_DENSITY).density, 2 * payload.density)


def test_colours_are_stored_encoded():
    payload = random_payload()
    red = pack(payload, FULL_DENSITY)[0, 0, 0] / 0.182 / 2 + 0.5
    torch.testing.assert_close(red, encode_srgb(payload.rgb[0, 0, 0, 0, 0]))


def test_values_outside_the_range_of_people_are_clamped_on_the_way_out():
    low, high = (unpack(torch.full((56, 256, 256), value), FULL_DENSITY) for value in (-1.0, 1.0))
    assert low.rgb.unique().tolist() == low.density.unique().tolist() == low.delta_scale.unique().tolist() == [0.0]
    assert high.rgb.unique().tolist() == [1.0]
    assert high.density.min() > FULL_DENSITY


def test_gradients_flow_through_both_directions():
    payload = random_payload().map(lambda tensor: tensor.requires_grad_())
    unpack(pack(payload, FULL_DENSITY), FULL_DENSITY).rgb.sum().backward()
    torch.testing.assert_close(payload.rgb.grad, torch.ones_like(payload.rgb), atol=1e-9, rtol=0)


def test_wrong_shapes_densities_and_nan_are_rejected():
    with refused(ValueError, "(56, 256, 256)"):
        # Under the tests' shape checks the annotation would speak first.
        inspect.unwrap(unpack)(torch.zeros(56, 256, 128), FULL_DENSITY)
    for full_density in (0.0, -1.0, float("nan")):
        with refused(ValueError, "full_density"):
            pack(random_payload(), full_density)
    broken = random_payload()
    broken.density[0, 0, 0, 0] = torch.nan
    with refused(ValueError, "density", "NaN"):
        pack(broken, FULL_DENSITY)
