"""The fast marcher against the readable one in float64, over the scenes that break marchers."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from march_scenes import assert_equals, camera_at, one_box, random_boxes
from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.cpu.march import _scene, _view, count_samples, march_cpu
from primdiffusion.render.lattice import RELEASED, MarchSettings, Span
from primdiffusion.render.march import march
from primdiffusion.render.reference import march_reference

INDEX_ORDER = MarchSettings(compositing="index_order")


def assert_agree(
    boxes: Primitives,
    camera: Camera,
    settings: MarchSettings = MarchSettings(),  # noqa: B008
    span: Span | None = None,
) -> None:
    got = march_cpu(boxes.to(dtype=torch.float32), camera.to(dtype=torch.float32), settings, span)
    expected = march_reference(boxes.to(dtype=torch.float32).to(dtype=torch.float64), camera, settings, span)
    densest = float(boxes.density.max()) if boxes.density.numel() else 0.0
    assert_equals(got, expected, densest, settings.step)


@pytest.mark.parametrize("seed", range(6))
def test_agrees_on_overlapping_boxes_from_thin_to_saturating(seed):
    boxes = random_boxes(40, seed, density=10.0 * 3**seed)
    assert_agree(boxes, camera_at((0.2, 0.1, 0.6), fov=0.6, width=50, height=37))


def test_agrees_on_rays_along_the_faces_of_boxes():
    """Axis-parallel boxes seen along their axes, with faces in the pixel centres' planes: nothing may turn NaN."""
    row = torch.linspace(-0.2, 0.2, 9, dtype=torch.float64)
    boxes = Primitives(*(tensor.expand(9, *tensor.shape[1:]).clone() for tensor in vars(one_box(0.025, 30.0)).values()))
    boxes.position[:, 0] = row
    camera = camera_at((0.0, 0.0, 0.5), width=9, height=9)
    for shift in (0.0, 0.025):
        moved = dataclasses.replace(boxes, position=boxes.position + torch.tensor([shift, 0.0, 0.0]).double())
        got = march_cpu(moved.to(dtype=torch.float32), camera.to(dtype=torch.float32))
        assert torch.isfinite(got.rgb).all()
        assert_agree(dataclasses.replace(moved, position=moved.position + 1e-4), camera)


def test_nothing_gives_an_empty_picture():
    camera = camera_at((0.0, 0.0, 0.5)).to(dtype=torch.float32)
    nobody = random_boxes(3).to(dtype=torch.float32).map(lambda tensor: tensor[:0])
    away = dataclasses.replace(random_boxes(3).to(dtype=torch.float32), position=torch.full((3, 3), 5.0))
    for boxes in (nobody, away):
        for render in (march_cpu, march_reference):
            got = render(boxes, camera)
            assert got.rgb.shape == (20, 24, 3)
            assert got.alpha.max() == 0
            assert torch.isinf(got.depth).all()
            assert torch.isinf(got.first_hit).all()


def test_boxes_without_extent_draw_nothing_and_disturb_nothing():
    boxes, camera = random_boxes(8, 15).to(dtype=torch.float32), camera_at((0.0, 0.0, 0.5)).to(dtype=torch.float32)
    flat = boxes.map(torch.clone)
    flat.half_extent[[1, 5]] = torch.tensor([[0.0, 0.1, 0.1], [0.0, 0.0, 0.0]])
    kept = boxes.map(lambda tensor: tensor[[0, 2, 3, 4, 6, 7]])
    for render in (march_cpu, march_reference):
        assert torch.equal(render(flat, camera).rgb, render(kept, camera).rgb)


def test_march_takes_the_reference_for_float64_and_the_fast_one_for_float32_with_gradients_or_without():
    boxes, camera = random_boxes(4, 18), camera_at((0.0, 0.0, 0.5))
    assert march(boxes, camera).rgb.dtype == torch.float64
    single, view = boxes.to(dtype=torch.float32), camera.to(dtype=torch.float32)
    assert torch.equal(march(single, view).rgb, march_cpu(single, view).rgb)
    leaf = dataclasses.replace(single, density=single.density.clone().requires_grad_())
    assert march(leaf, view).rgb.requires_grad
    with torch.no_grad():
        assert torch.equal(march(leaf, view).rgb, march_cpu(single, view).rgb)


def test_threads_may_march_at_the_same_time():
    boxes, camera = random_boxes(40, 19).to(dtype=torch.float32), camera_at((0.0, 0.0, 0.5)).to(dtype=torch.float32)
    alone = march_cpu(boxes, camera).rgb
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda _: march_cpu(boxes, camera).rgb, range(8)))
    assert all(torch.equal(rgb, alone) for rgb in together)


def half_empty(count: int, seed: int, density: float = 60.0) -> Primitives:
    """Boxes as a person's: density in an inner slab of cells only; one holds nothing, one a single voxel."""
    boxes = random_boxes(count, seed, density=density)
    boxes.density[:, 5:] = 0
    boxes.density[:, :, :2] = 0
    boxes.density[::3, :, :, 4:] = 0
    boxes.density[0] = 0
    boxes.density[1] = 0
    boxes.density[1, 3, 4, 2] = density
    return boxes


@pytest.mark.parametrize("settings", [MarchSettings(), MarchSettings(compositing="index_order")])
def test_leaving_out_empty_cells_does_not_change_the_picture(settings):
    boxes, camera = half_empty(30, 20), camera_at((0.2, 0.1, 0.6), fov=0.5, width=50, height=37)
    assert_agree(boxes, camera, settings)
    counted = count_samples(boxes.to(dtype=torch.float32), camera.to(dtype=torch.float32), settings)
    assert counted.evaluated < 0.6 * counted.inside_boxes


@pytest.mark.parametrize("density", [10.0, 90.0, 800.0])
@pytest.mark.parametrize("settings", [dataclasses.replace(RELEASED, pixel_centre=0.5), INDEX_ORDER])
def test_agrees_where_boxes_follow_one_another_in_index_order(density, settings):
    boxes = random_boxes(30, 21, spread=0.05, density=density)
    camera = camera_at((0.2, 0.1, 0.6), fov=0.3)
    assert_agree(boxes, camera, settings)
    single, view = boxes.to(dtype=torch.float32), camera.to(dtype=torch.float32)
    mixed = dataclasses.replace(settings, compositing="mixed")
    differs = (march_cpu(single, view, settings).rgb - march_cpu(single, view, mixed).rgb).abs().max()
    assert differs > 1e-3 or density == 10.0  # the two rules differ on rays that saturate


@pytest.mark.parametrize("settings", [MarchSettings(), INDEX_ORDER])
def test_agrees_within_spans(settings):
    boxes, camera = random_boxes(30, 22, density=60.0), camera_at((0.2, 0.1, 0.6), fov=0.5)
    generator = torch.Generator().manual_seed(2)
    near = 0.45 + 0.2 * torch.rand((camera.height, camera.width), generator=generator)
    far = near + 0.3 * torch.rand(near.shape, generator=generator) - 0.03  # some are empty
    near[0], far[1] = 0.0, torch.inf
    far[2], near[3] = -1.0, torch.inf
    assert_agree(boxes, camera, settings, Span(near, far))


def test_thousands_of_boxes_over_one_pixel_are_all_seen():
    """No list has room for so many and no more: the opacity of all of them adds up."""
    count = 20_000
    generator = torch.Generator().manual_seed(26)
    boxes = Primitives(
        position=torch.randn((count, 3), generator=generator) * torch.tensor([1e-3, 1e-3, 0.5]),
        rotation=torch.eye(3).expand(count, 3, 3).contiguous(),
        half_extent=torch.full((count, 3), 0.02),
        rgb=torch.full((count, 3, 2, 2, 2), 0.5),
        density=torch.full((count, 2, 2, 2), 1e-3),
    )
    camera = camera_at((0.0, 0.0, 4.0), fov=1e-3, width=2, height=2).to(dtype=torch.float32)
    together = march_cpu(boxes, camera)
    parts = [march_cpu(boxes.map(lambda tensor, i=i: tensor[i::4]), camera).alpha for i in range(4)]
    assert together.alpha.min() > 0.5
    torch.testing.assert_close(together.alpha, torch.stack(parts).sum(0), rtol=1e-5, atol=0)


def test_a_box_is_looked_at_in_the_few_tiles_it_covers_and_nowhere_else():
    """Sixteen people of 4096 boxes: boxes x pixels would be 4.3e9 tests."""
    count = 16 * 4096
    generator = torch.Generator().manual_seed(27)
    position = torch.rand((count, 3), generator=generator) * 4 - 2
    boxes = Primitives(
        position=position,
        rotation=torch.eye(3).expand(count, 3, 3),
        half_extent=torch.full((count, 3), 0.004),
        rgb=torch.full((count, 3, 2, 2, 2), 0.5),
        density=torch.full((count, 2, 2, 2), 10.0),
    )
    camera = camera_at((0.0, 0.0, 8.0), fov=0.5, width=256, height=256).to(dtype=torch.float32)
    inputs = _view(boxes, camera, MarchSettings(), None)
    scene = _scene(inputs, (boxes.rgb, boxes.density, *inputs[:3]), empty_cells=False)
    first_column, last_column, first_row, last_row = scene.rectangle.astype(int).T
    covered = np.maximum(last_column - first_column + 1, 0) * np.maximum(last_row - first_row + 1, 0)
    assert 0 < covered.sum() < 2 * count
    assert covered.max() <= 4  # of 1024 tiles


def test_boxes_across_the_cameras_plane_are_listed_only_where_they_can_be_seen():
    boxes = one_box(0.05, 20.0)
    boxes.position[:] = torch.tensor([[0.06, 0.0, 0.5]])  # beside the camera, half of it behind
    camera = camera_at((0.0, 0.0, 0.5), fov=1.8, width=128, height=128)
    assert_agree(boxes, camera)
    single, view = boxes.to(dtype=torch.float32), camera.to(dtype=torch.float32)
    left = march_cpu(single, view).alpha[:, :60]
    assert left.max() == 0
    inputs = _view(single, view, MarchSettings(), None)
    scene = _scene(inputs, (single.rgb, single.density, *inputs[:3]), empty_cells=False)
    assert scene.rectangle[0, 0] >= 8  # of 16 columns of tiles
