"""Primitives in one grid: as a slow twin sums them, by hand where one box is alone, within limits."""

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from primdiffusion.geometry.rotation import axis_angle_to_matrix
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render import merge as merging
from primdiffusion.render.merge import Merged, merge
from primdiffusion.render.reference import trilinear, window
from support.errors import refused


def boxes(count: int = 5, seed: int = 0, spread: float = 0.06) -> Primitives:
    """Turned boxes of several sizes that overlap."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=generator)

    turns = axis_angle_to_matrix((uniform(count, 3) - 0.5) * 6)
    density = uniform(count, 8, 8, 8) * 40
    density[:, :3] = 0  # empty outside the skin, as boxes are
    half = 0.02 + 0.03 * uniform(count, 3)
    return Primitives((uniform(count, 3) - 0.5) * spread, turns, half, uniform(count, 3, 8, 8, 8), density)


def merged_slowly(primitives: Primitives, like: Merged, points: int) -> tuple[np.ndarray, np.ndarray]:
    """The same sums at every voxel of the grid `like`, by the marcher's reference functions, in float64."""
    primitives = primitives.to(dtype=torch.float64)
    shape = like.density.shape
    index = torch.stack(torch.meshgrid(*(torch.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 3)
    density, colour = torch.zeros(len(index)).double(), torch.zeros(len(index), 3).double()
    for shift in itertools.product(range(points), repeat=3):
        place = (index + (torch.tensor(shift) + 0.5) / points - 0.5) * like.voxel + torch.from_numpy(like.origin)
        for k in range(len(primitives.density)):
            local = (place - primitives.position[k]) @ primitives.rotation[k] / primitives.half_extent[k]
            inside = (local.abs() < 1).all(-1)
            box = torch.full((int(inside.sum()),), k)
            voxels = torch.cat([primitives.rgb, primitives.density[:, None]], 1)
            rgb, opacity = trilinear(voxels, box, local[inside]).split((3, 1), -1)
            opacity = opacity[:, 0] * window(local[inside]) / points**3
            density[inside] += opacity
            colour[inside] += opacity[:, None] * rgb
    return density.reshape(shape).numpy(), colour.reshape(*shape, 3).numpy()


@pytest.mark.parametrize("points", [1, 2])
def test_a_grid_is_what_the_slow_twin_sums(points):
    primitives = boxes()
    grid = merge(primitives, 0.006, points)
    density, colour = merged_slowly(primitives, grid, points)
    full = density >= merging.FAINTEST * 1.001
    assert full.sum() > 1000
    np.testing.assert_allclose(grid.density[full], np.minimum(density, 1 / 0.006)[full], rtol=2e-4)  # float32
    np.testing.assert_allclose(grid.colour[full], colour[full] / density[full][:, None], atol=2e-5)
    assert (grid.density[density < merging.FAINTEST * 0.999] == 0).all()


def test_the_grid_holds_all_opacity_there_is():
    primitives = boxes(1)
    grid = merge(primitives, 0.002)
    step = torch.linspace(-1, 1, 81)[:-1] + 1 / 80
    local = torch.cartesian_prod(step, step, step)
    values = trilinear(primitives.density[:, None], torch.zeros(len(local), dtype=torch.int64), local)[:, 0]
    whole = float((values * window(local)).mean() * 8 * primitives.half_extent.prod())
    assert grid.density.sum() * 0.002**3 == pytest.approx(whole, rel=0.01)


def test_the_order_of_the_boxes_does_not_matter():
    primitives = boxes(6)
    turned = Primitives(**{name: value.flip(0) for name, value in vars(primitives).items()})
    np.testing.assert_allclose(merge(primitives).density, merge(turned).density, atol=1e-4)


def test_density_stops_where_a_voxel_is_full():
    primitives = boxes(8, spread=0.01)
    dense = dataclasses.replace(primitives, density=primitives.density * 100)
    assert merge(dense, 0.006).density.max() == np.float32(1 / 0.006)


def test_empty_voxels_beside_others_have_their_colour_and_no_density():
    primitives = boxes(1)
    red = dataclasses.replace(
        primitives, rgb=torch.tensor([0.8, 0.1, 0.2])[None, :, None, None, None].expand(1, 3, 8, 8, 8)
    )
    grid = merge(red, 0.006)
    rim = (grid.density == 0) & (grid.colour[..., 0] > 0)
    assert rim.sum() > 100
    np.testing.assert_allclose(grid.colour[rim], np.broadcast_to([0.8, 0.1, 0.2], (rim.sum(), 3)), atol=1e-5)
    assert (grid.density[0] == 0).all()
    assert (grid.density[:, :, -1] == 0).all()


def test_grids_of_several_poses_share_a_lattice():
    primitives = boxes()
    moved = dataclasses.replace(primitives, position=primitives.position + torch.tensor([0.006 * 7, 0.0, -0.006 * 3]))
    here, there = merge(primitives), merge(moved)
    np.testing.assert_allclose((there.origin - here.origin) / 0.006, [7, 0, -3], atol=1e-6)
    np.testing.assert_allclose(there.density, here.density, atol=2e-3)


def test_boxes_without_extent_or_content_hold_nothing():
    primitives = boxes(3)
    half, density = primitives.half_extent.clone(), primitives.density.clone()
    half[0, 1], density[1] = 0, 0
    left = Primitives(**{name: value[2:] for name, value in vars(primitives).items()})
    grid = merge(dataclasses.replace(primitives, half_extent=half, density=density))
    np.testing.assert_array_equal(grid.density, merge(left).density)
    assert merge(dataclasses.replace(primitives, density=density * 0)).density.max() == 0


@pytest.mark.parametrize(
    ("voxel", "message"),
    [(0.0, "above zero"), (-1.0, "above zero"), (1e-5, "mm or more"), (float("nan"), "above zero")],
)
def test_voxels_that_cannot_be_are_rejected_with_what_to_do(voxel, message):
    with refused(ValueError, message):
        merge(boxes(), voxel)
