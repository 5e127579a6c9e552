"""The readable marcher against hand counts, a brute-force loop written from SPEC 4, gradcheck and its own limit."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from march_scenes import camera_at, one_box, random_boxes
from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render import reference
from primdiffusion.render.lattice import MarchSettings, Span
from primdiffusion.render.reference import march_reference
from scipy.integrate import quad
from support.errors import refused

WINDOW_INTEGRAL = quad(lambda y: math.exp(-8 * y**8), -1, 1)[0]


def brute_force(boxes: Primitives, camera: Camera, settings: MarchSettings, span: Span | None = None) -> np.ndarray:
    """[H, W, 6] rgb, alpha, depth, first hit: every lattice point of every ray against every box, one at a time."""
    position, rotation, half, rgb, density = (value.numpy() for value in vars(boxes).values())
    k = camera.intrinsics.numpy()
    r, t = camera.world_to_camera[:, :3].numpy(), camera.world_to_camera[:, 3].numpy()
    origin = -r.T @ t
    picture = np.zeros((camera.height, camera.width, 6))
    stride = []
    for box in range(len(position)):
        voxel = 2 * half[box].min() / 7
        fitting = [s for s in settings.strides if s * settings.spacing * settings.samples_per_voxel <= voxel]
        stride.append(max(fitting, default=min(settings.strides)))
    reach = np.linalg.norm(origin - position, axis=1).max() + np.linalg.norm(half, axis=1).max()
    for row, column in itertools.product(range(camera.height), range(camera.width)):
        d = r.T @ np.array([(column + 0.5 - k[0, 2]) / k[0, 0], (row + 0.5 - k[1, 2]) / k[1, 1], 1.0])
        d /= np.linalg.norm(d)
        alpha, colour, moment, first = 0.0, np.zeros(3), 0.0, math.inf
        for n in range(1, int(reach / settings.spacing) + 2):
            if span is not None and not span.near[row, column] <= n * settings.spacing <= span.far[row, column]:
                continue
            total, mixed = 0.0, np.zeros(3)
            for box in range(len(position)):
                if n % stride[box]:
                    continue
                y = rotation[box].T @ (origin + n * settings.spacing * d - position[box]) / half[box]
                if np.abs(y).max() >= 1:
                    continue
                u = (y + 1) / 2 * 7
                i = np.minimum(np.floor(u).astype(int), 6)
                f = u - i
                value = np.zeros(4)
                for ox, oy, oz in itertools.product((0, 1), repeat=3):
                    w = (f[0] if ox else 1 - f[0]) * (f[1] if oy else 1 - f[1]) * (f[2] if oz else 1 - f[2])
                    at = (i[2] + oz, i[1] + oy, i[0] + ox)
                    value += w * np.array([*rgb[(box, slice(None), *at)], density[(box, *at)]])
                a = value[3] * math.exp(-8 * (y**8).sum()) * stride[box] * settings.spacing
                total += a
                mixed += a * value[:3]
            if total == 0:
                continue
            increase = min(alpha + total, 1.0) - alpha
            alpha += increase
            colour += increase * mixed / total
            moment += increase * n * settings.spacing
            if alpha >= 0.5 and first == math.inf:
                first = n * settings.spacing
            if alpha >= 1:
                break
        picture[row, column] = [*colour, alpha, moment / alpha if alpha else math.inf, first]
    return picture


@pytest.mark.parametrize(
    ("count", "seed", "density", "settings"),
    [
        (4, 0, 10.0, MarchSettings()),
        (12, 1, 60.0, MarchSettings()),
        (6, 2, 40.0, MarchSettings(step=0.003, strides=(1,))),
        (6, 3, 400.0, MarchSettings(step=0.006, strides=(6, 3, 1), samples_per_voxel=1.0)),
    ],
)
def test_agrees_with_a_brute_force_loop_written_from_the_specification(count, seed, density, settings):
    boxes = random_boxes(count, seed, density=density)
    camera = camera_at((0.1, 0.05, 0.4), fov=0.6, width=4, height=3)
    expected = brute_force(boxes, camera, settings)
    got = march_reference(boxes, camera, settings)
    assert np.isfinite(expected[..., 4]).any()
    np.testing.assert_allclose(got.rgb.numpy(), expected[..., :3], atol=1e-12)
    for name, channel in (("alpha", 3), ("depth", 4), ("first_hit", 5)):
        np.testing.assert_allclose(getattr(got, name).numpy(), expected[..., channel], atol=1e-12)


def test_a_camera_inside_a_box_agrees_with_the_brute_force_loop():
    boxes = random_boxes(5, 4, density=20.0, smallest=0.1, largest=0.2)
    camera = camera_at((0.02, 0.01, 0.03), fov=1.5, width=3, height=3)
    got = march_reference(boxes, camera)
    np.testing.assert_allclose(got.rgb.numpy(), brute_force(boxes, camera, MarchSettings())[..., :3], atol=1e-12)


def single_ray(distance: float) -> Camera:
    """One pixel whose ray runs along -z through the origin, from `distance` in front of it."""
    return camera_at((0.0, 0.0, distance), width=1, height=1)


def test_one_box_is_density_times_the_integral_of_the_window():
    got = march_reference(one_box(half_extent=0.05, density=4.0), single_ray(0.5), MarchSettings(0.0005, (1,)))
    expected = 4.0 * 0.05 * WINDOW_INTEGRAL
    torch.testing.assert_close(got.alpha.item(), expected, rtol=1e-4, atol=0)
    torch.testing.assert_close(got.rgb[0, 0], expected * torch.tensor([0.2, 0.4, 0.8]).double(), rtol=1e-4, atol=0)
    assert got.depth.item() == pytest.approx(0.5, abs=1e-4)


def test_released_order_favours_the_lower_index_at_the_saturating_sample_and_only_there():
    red, blue = one_box(density=100.0, rgb=(1, 0, 0)), one_box(density=100.0, rgb=(0, 0, 1))
    both = Primitives(*(torch.cat([getattr(red, name), getattr(blue, name)]) for name in vars(red)))
    coarse = MarchSettings(step=0.004, strides=(1,))
    in_order = dataclasses.replace(coarse, compositing="index_order")
    mixed, released = (march_reference(both, single_ray(0.5), rule).rgb[0, 0] for rule in (coarse, in_order))
    assert mixed[0].item() == pytest.approx(0.5)
    assert released[0].item() > released[2].item() + 0.05
    thin = dataclasses.replace(both, density=both.density / 100)
    torch.testing.assert_close(
        march_reference(thin, single_ray(0.5), in_order).rgb, march_reference(thin, single_ray(0.5), coarse).rgb
    )


def test_sampling_converges_with_second_order_and_the_default_is_close_to_its_limit():
    boxes, camera = random_boxes(12, 7, density=60.0, smallest=0.02), camera_at((0.1, 0.1, 0.5), fov=0.5)
    limit = march_reference(boxes, camera, MarchSettings(0.00025, (1,))).rgb
    assert (limit.sum(-1) > 0).any()

    def error(settings: MarchSettings) -> torch.Tensor:
        return (march_reference(boxes, camera, settings).rgb - limit).abs() * 255

    steps = (0.008, 0.004, 0.002, 0.001)
    uniform = [error(MarchSettings(step, (1,))).mean().item() for step in steps]
    order = np.polyfit(np.log(steps), np.log(uniform), 1)[0]
    assert order > 1.8, f"mean errors {uniform} fall with order {order}"
    # Contents are white noise, the roughest there are; measured 0.11 on average, 2.0 at most.
    assert error(MarchSettings()).mean() < 0.15
    assert error(MarchSettings()).max() < 2.5
    assert error(MarchSettings()).mean() <= uniform[1]


def test_a_span_leaves_out_what_lies_before_and_behind_it():
    boxes, camera = random_boxes(8, 20, density=25.0), camera_at((0.1, 0.0, 0.5), fov=0.5, width=5, height=4)
    generator = torch.Generator().manual_seed(3)
    near = 0.35 + 0.1 * torch.rand((4, 5), generator=generator, dtype=torch.float64)
    far = near + 0.15 * torch.rand((4, 5), generator=generator, dtype=torch.float64)
    whole = march_reference(boxes, camera)
    cut = march_reference(boxes, camera, span=Span(near, far))
    expected = brute_force(boxes, camera, MarchSettings(), Span(near, far))
    np.testing.assert_allclose(cut.rgb.numpy(), expected[..., :3], atol=1e-12)
    np.testing.assert_allclose(cut.depth.numpy(), expected[..., 4], atol=1e-12)
    assert (cut.alpha < whole.alpha - 1e-3).any()
    # A span and the one that follows it add up, as long as nothing saturates.
    thin = dataclasses.replace(boxes, density=boxes.density / 100)
    before, behind = Span(near * 0, near), Span(near + 1e-12, far * 0 + torch.inf)
    parts = [march_reference(thin, camera, span=part).alpha for part in (before, behind)]
    torch.testing.assert_close(parts[0] + parts[1], march_reference(thin, camera).alpha)


def test_empty_and_unlimited_spans():
    boxes, camera = random_boxes(8, 21), camera_at((0.1, 0.0, 0.5), width=5, height=4)
    nothing, everything = torch.zeros((4, 5)).double(), torch.full((4, 5), torch.inf).double()
    assert march_reference(boxes, camera, span=Span(nothing + 1, nothing)).alpha.max() == 0
    same = march_reference(boxes, camera, span=Span(nothing, everything))
    assert torch.equal(same.rgb, march_reference(boxes, camera).rgb)


@pytest.mark.parametrize(("density", "saturates"), [(2.0, False), (60.0, True)])
def test_gradients_of_boxes_and_camera_agree_with_finite_differences(density, saturates):
    boxes = random_boxes(2, 8, density=density, size=2, spread=0.02, smallest=0.03)
    boxes = dataclasses.replace(boxes, density=boxes.density + density)
    camera = camera_at((0.05, 0.02, 0.3), fov=0.15, width=2, height=2)
    settings = MarchSettings(step=0.01, strides=(2, 1))
    assert bool((march_reference(boxes, camera, settings).alpha == 1).any()) is saturates
    tensors = [*vars(boxes).values(), camera.intrinsics, camera.world_to_camera]

    def picture(*values):
        view = dataclasses.replace(camera, intrinsics=values[5], world_to_camera=values[6])
        got = march_reference(Primitives(*values[:5]), view, settings)
        return got.rgb, got.alpha, got.depth

    inputs = tuple(tensor.clone().requires_grad_() for tensor in tensors)
    assert torch.isfinite(picture(*inputs)[2]).all()
    assert torch.autograd.gradcheck(picture, inputs, eps=1e-7, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    "case",
    [
        "inside a box",
        "grazing",
        pytest.param("overlapping and saturating", marks=pytest.mark.slow),
        pytest.param("index order", marks=pytest.mark.slow),
    ],
)
def test_gradients_agree_with_finite_differences_where_marchers_break(case):
    boxes = random_boxes(2, 22, density=30.0, size=3, spread=0.02, smallest=0.04)
    camera = camera_at((0.05, 0.02, 0.3), fov=0.2, width=2, height=2)
    settings = MarchSettings(step=0.01, strides=(2, 1))
    if case == "inside a box":
        camera = camera_at((0.01, 0.005, 0.02), fov=0.8, width=2, height=2)
    elif case == "grazing":
        boxes = dataclasses.replace(one_box(0.05, 20.0), rgb=boxes.rgb[:1], density=boxes.density[:1])
        # Outer rays run just inside the faces; nothing runs along the edges of cells, where there are kinks.
        camera = camera_at((0.003, 0.002, 0.4), fov=0.36, width=3, height=3)
    else:
        boxes = dataclasses.replace(boxes, density=boxes.density + 40.0)
        compositing = "index_order" if case == "index order" else "mixed"
        settings = dataclasses.replace(settings, compositing=compositing)
        assert (march_reference(boxes, camera, settings).alpha == 1).any()
    tensors = [*vars(boxes).values(), camera.intrinsics, camera.world_to_camera]
    seen = march_reference(boxes, camera, settings).alpha > 0
    assert seen.any()

    def picture(*values):
        view = dataclasses.replace(camera, intrinsics=values[5], world_to_camera=values[6])
        got = march_reference(Primitives(*values[:5]), view, settings)
        return got.rgb, got.alpha, got.depth[seen]

    inputs = tuple(tensor.clone().requires_grad_() for tensor in tensors)
    assert torch.autograd.gradcheck(picture, inputs, eps=1e-8, atol=1e-4, rtol=1e-3)


def test_gradients_are_finite_with_grazed_empty_and_flat_boxes():
    boxes = random_boxes(6, 9)
    boxes.half_extent[0, 1] = 0.0
    boxes.density[1] = 0.0
    inputs = boxes.map(lambda tensor: tensor.requires_grad_())
    got = march_reference(inputs, camera_at((0.0, 0.0, 0.5), fov=1.0))
    (got.rgb.sum() + got.alpha.sum() + got.depth[got.alpha > 0].sum()).backward()
    assert all(torch.isfinite(tensor.grad).all() for tensor in vars(inputs).values())
    assert all(tensor.grad.abs().max() > 0 for tensor in vars(inputs).values())


def test_mixed_and_narrow_dtypes_are_rejected_with_a_way_out():
    boxes, camera = random_boxes(2), camera_at((0.0, 0.0, 0.5))
    with refused(ValueError, "dtypes"):
        march_reference(boxes.to(dtype=torch.float32), camera)
    with refused(ValueError, "float32"):
        march_reference(boxes.to(dtype=torch.bfloat16), camera.to(dtype=torch.bfloat16))


def test_memory_is_bounded_by_cutting_the_picture_and_no_ray_may_ask_for_all_of_it(monkeypatch):
    boxes, camera = random_boxes(30, 2), camera_at((0.2, 0.1, 0.6))
    whole = march_reference(boxes, camera)
    monkeypatch.setattr(reference, "PAIRS_AT_ONCE", 100)
    monkeypatch.setattr(reference, "SAMPLES_AT_ONCE", 2000)
    cut = march_reference(boxes, camera)
    for name in ("rgb", "alpha", "depth", "first_hit"):
        torch.testing.assert_close(getattr(cut, name), getattr(whole, name), atol=1e-12, rtol=0)
    monkeypatch.setattr(reference, "SAMPLES_AT_ONCE", 10)
    with refused(ValueError, "samples"):
        march_reference(boxes, camera)
