"""The CPU marcher's hand-written adjoint against torch's through the readable marcher in float64."""

import dataclasses

import pytest
import torch
from march_scenes import assert_same_direction_and_length, camera_at, gradients, objective, random_boxes
from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.cpu.march import march_cpu
from primdiffusion.render.lattice import UNIFORM_MILLIMETRE, MarchSettings, Span
from primdiffusion.render.reference import march_reference
from support.errors import refused

INDEX_ORDER = MarchSettings(compositing="index_order")
MIXED_STRIDES = MarchSettings(step=0.008, strides=(4, 2, 1))


def assert_gradients_agree(
    boxes: Primitives,
    camera: Camera,
    settings: MarchSettings = MarchSettings(),  # noqa: B008
    span: Span | None = None,
) -> None:
    """For each input."""
    single, view = boxes.to(dtype=torch.float32), camera.to(dtype=torch.float32)
    got = gradients(lambda b, c: march_cpu(b, c, settings, span), single, view)
    exact_span = None if span is None else span.to(dtype=torch.float64)
    expected = gradients(
        lambda b, c: march_reference(b, c, settings, exact_span),
        single.to(dtype=torch.float64), view.to(dtype=torch.float64),
    )  # fmt: skip
    for name, gradient in expected.items():
        assert gradient.norm() > 0, name
        assert_same_direction_and_length(got[name], gradient, name)


@pytest.mark.parametrize(("density", "settings"), [
    (2.0, MarchSettings()), (40.0, MarchSettings()), (400.0, MarchSettings()), (40.0, UNIFORM_MILLIMETRE),
    (60.0, MIXED_STRIDES), (60.0, INDEX_ORDER), (400.0, INDEX_ORDER),
])  # fmt: skip
def test_gradients_from_thin_to_saturating_rays(density, settings):
    assert_gradients_agree(random_boxes(24, 1, density=density), camera_at((0.2, 0.1, 0.6), fov=0.5), settings)


def test_gradients_where_many_boxes_overlap():
    boxes = random_boxes(30, 2, spread=0.02, density=20.0)
    for settings in (MarchSettings(), INDEX_ORDER):
        assert_gradients_agree(boxes, camera_at((0.2, 0.1, 0.6), fov=0.25), settings)


def test_gradients_with_the_camera_inside_boxes_and_boxes_across_its_plane():
    boxes = random_boxes(12, 12, density=15.0, smallest=0.05, largest=0.15)
    for position in ((0.01, 0.0, 0.02), (0.0, 0.1, 0.1), (0.15, 0.0, 0.0)):
        assert_gradients_agree(boxes, camera_at(position, fov=1.8, width=25, height=19))


def test_gradients_of_boxes_that_rays_graze():
    """Plates seen along their planes, so that each ray runs near two faces."""
    boxes = random_boxes(10, 3, density=30.0)
    boxes.rotation[:] = torch.eye(3, dtype=torch.float64)
    boxes.half_extent[:, 1] = 0.004
    assert_gradients_agree(boxes, camera_at((0.0, 0.003, 0.6), fov=0.4, width=40, height=40))


def test_gradients_of_matrices_that_are_no_rotations():
    """Training may step off the manifold: the derivative is that of the formula, whatever the matrix."""
    boxes = random_boxes(10, 4, density=30.0)
    generator = torch.Generator().manual_seed(0)
    bent = boxes.rotation + 1e-3 * torch.randn(boxes.rotation.shape, generator=generator, dtype=torch.float64)
    camera = camera_at((0.2, 0.1, 0.6), fov=0.5)
    skewed = camera.intrinsics.clone()
    skewed[0, 1] = 3.0
    camera = dataclasses.replace(camera, intrinsics=skewed, world_to_camera=camera.world_to_camera * 1.01)
    assert_gradients_agree(dataclasses.replace(boxes, rotation=bent), camera)


@pytest.mark.parametrize("settings", [MarchSettings(), INDEX_ORDER])
def test_gradients_within_spans(settings):
    boxes, camera = random_boxes(24, 6, density=80.0), camera_at((0.2, 0.1, 0.6), fov=0.5)
    generator = torch.Generator().manual_seed(1)
    near = 0.5 + 0.2 * torch.rand((camera.height, camera.width), generator=generator)
    far = near + 0.2 * torch.rand(near.shape, generator=generator) - 0.02
    far[::3] = torch.inf
    assert_gradients_agree(boxes, camera, settings, Span(near, far))


def test_each_input_gets_the_same_gradient_alone():
    """Sums that nobody needs are skipped; the others must not notice."""
    boxes = random_boxes(12, 7, density=100.0).to(dtype=torch.float32)
    camera = camera_at((0.2, 0.1, 0.6), fov=0.5).to(dtype=torch.float32)
    together = gradients(march_cpu, boxes, camera)
    for name, expected in together.items():
        alone = camera if name in vars(camera) else boxes
        leaf = getattr(alone, name).clone().requires_grad_()
        changed = dataclasses.replace(alone, **{name: leaf})
        picture = march_cpu(*((boxes, changed) if alone is camera else (changed, camera)))
        (got,) = torch.autograd.grad(objective(picture), [leaf])
        torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()), msg=name)


def test_empty_voxels_receive_the_gradient_of_becoming_dense():
    """Where nothing is, the picture skips samples; the slope towards something must still be seen."""
    boxes = random_boxes(6, 8, density=20.0)
    boxes.density[:, 4:] = 0
    boxes.density[3] = 0
    camera = camera_at((0.2, 0.1, 0.6), fov=0.5)
    direction = torch.where(boxes.density == 0, torch.rand_like(boxes.density), 0)

    def value(amount: float) -> float:
        changed = dataclasses.replace(boxes, density=boxes.density + amount * direction)
        picture = march_reference(changed, camera)
        return float(objective(picture, depth=False))

    expected = (value(1e-4) - value(0.0)) / 1e-4
    single = boxes.to(dtype=torch.float32)
    density = single.density.clone().requires_grad_()
    picture = march_cpu(dataclasses.replace(single, density=density), camera.to(dtype=torch.float32))
    objective(picture, depth=False).backward()
    assert float((density.grad.double() * direction).sum()) == pytest.approx(expected, rel=2e-3)


def test_gradients_repeat_bit_for_bit():
    boxes = random_boxes(40, 9, density=60.0).to(dtype=torch.float32)
    camera = camera_at((0.2, 0.1, 0.6), fov=0.5, width=64, height=48).to(dtype=torch.float32)
    first, second = (gradients(march_cpu, boxes, camera) for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_recording_gradients_does_not_change_the_picture():
    boxes = random_boxes(20, 10, density=60.0).to(dtype=torch.float32)
    camera = camera_at((0.2, 0.1, 0.6), fov=0.5).to(dtype=torch.float32)
    plain = march_cpu(boxes, camera)
    recorded = march_cpu(dataclasses.replace(boxes, density=boxes.density.clone().requires_grad_()), camera)
    assert all(torch.equal(value, getattr(recorded, name)) for name, value in vars(plain).items())
    assert recorded.depth.requires_grad
    assert not recorded.first_hit.requires_grad


def test_boxes_out_of_sight_or_without_extent_receive_zeros():
    boxes = random_boxes(4, 11, density=60.0).to(dtype=torch.float32)
    boxes.half_extent[1] = 0
    boxes.position[2] = torch.tensor([0.0, 0.0, 5.0])
    camera = camera_at((0.2, 0.1, 0.6), fov=0.5).to(dtype=torch.float32)
    for name, gradient in gradients(march_cpu, boxes, camera).items():
        assert torch.isfinite(gradient).all(), name
        if name in vars(boxes):
            assert gradient[[1, 2]].abs().max() == 0, name
            assert gradient[[0, 3]].abs().max() > 0, name


def test_a_second_derivative_is_rejected():
    boxes = random_boxes(4, 12).to(dtype=torch.float32)
    camera = camera_at((0.2, 0.1, 0.6), fov=0.5).to(dtype=torch.float32)
    density = boxes.density.clone().requires_grad_()
    loss = objective(march_cpu(dataclasses.replace(boxes, density=density), camera))
    with refused(RuntimeError, "differentiated"):
        torch.autograd.grad(loss, [density], create_graph=True)


def test_payloads_of_other_sizes_have_gradients_too():
    for size in (1, 2, 5):
        boxes = random_boxes(10, 13, density=40.0, size=size)
        assert_gradients_agree(boxes, camera_at((0.2, 0.1, 0.6), fov=0.5))


def test_no_boxes_have_gradients_of_no_size():
    boxes = random_boxes(2, 14).to(dtype=torch.float32).map(lambda tensor: tensor[:0])
    camera = camera_at((0.2, 0.1, 0.6), fov=0.5).to(dtype=torch.float32)
    got = gradients(march_cpu, boxes, camera)
    assert got["rgb"].shape == (0, 3, 8, 8, 8)
    assert got["intrinsics"].abs().max() == 0
