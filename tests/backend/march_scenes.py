"""Scenes for the tests of the marcher and of what goes through it, and gradients of pictures of them."""

from collections.abc import Callable

import torch
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.rotation import axis_angle_to_matrix
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.image import Rendering
from torch import Tensor

FACE_STEP = 3.4e-4
"""The window's value at a face, by which a sample that rounding moves in or out of a box changes."""


def random_boxes(
    count: int,
    seed: int = 0,
    *,
    spread: float = 0.1,
    smallest: float = 0.01,
    largest: float = 0.06,
    density: float = 40.0,
    size: int = 8,
) -> Primitives:
    """Overlapping boxes around the origin with random contents; densities up to `density` per metre."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    return Primitives(
        position=(uniform(count, 3) * 2 - 1) * spread,
        rotation=axis_angle_to_matrix((uniform(count, 3) * 2 - 1) * 3),
        half_extent=smallest + (largest - smallest) * uniform(count, 3),
        rgb=uniform(count, 3, size, size, size),
        density=uniform(count, size, size, size) * density,
    )


def one_box(half_extent: float = 0.05, density: float = 1.0, rgb: tuple[float, ...] = (0.2, 0.4, 0.8)) -> Primitives:
    """A cube of constant contents at the origin, its axes the world's."""
    colour = torch.tensor(rgb, dtype=torch.float64)[None, :, None, None, None]
    return Primitives(
        position=torch.zeros((1, 3), dtype=torch.float64),
        rotation=torch.eye(3, dtype=torch.float64)[None],
        half_extent=torch.full((1, 3), half_extent, dtype=torch.float64),
        rgb=colour.expand(1, 3, 8, 8, 8).clone(),
        density=torch.full((1, 8, 8, 8), density, dtype=torch.float64),
    )


def camera_at(position: tuple[float, ...], *, fov: float = 0.3, width: int = 24, height: int = 20) -> Camera:
    """A camera that looks at the origin."""
    where = torch.tensor(position, dtype=torch.float64)
    return look_at(where, torch.zeros_like(where), vertical_fov=fov, width=width, height=height)


def objective(picture: Rendering, seed: int = 5, depth: bool = True) -> Tensor:
    """Every kind of output, weighted at random, of both signs; depths where they are finite."""
    generator = torch.Generator().manual_seed(seed)
    values = [picture.rgb, picture.alpha]
    if depth:
        values.append(torch.where(torch.isfinite(picture.depth), picture.depth, 0))
    return sum(
        (torch.randn(value.shape, generator=generator, dtype=torch.float64).to(value) * value).sum() for value in values
    )


def gradients(
    render: Callable[[Primitives, Camera], Rendering],
    boxes: Primitives,
    camera: Camera,
    value: Callable[[Rendering], Tensor] = objective,
) -> dict[str, Tensor]:
    """Gradients of a picture's value by the names of the inputs."""
    boxes, camera = (record.map(lambda tensor: tensor.detach().clone().requires_grad_()) for record in (boxes, camera))
    leaves = {**vars(boxes), "intrinsics": camera.intrinsics, "world_to_camera": camera.world_to_camera}
    return dict(zip(leaves, torch.autograd.grad(value(render(boxes, camera)), list(leaves.values())), strict=True))


def assert_equals(got: Rendering, expected: Rendering, densest: float, step: float, rounding: float = 0.0) -> None:
    """All fields within 2e-5 plus one flipped face sample of the densest box, on average within 2e-6.

    Depths may be off by a share of `rounding` more.
    """
    largest = 2e-5 + FACE_STEP * min(densest * step, 1)
    got = got.to(device="cpu", dtype=torch.float64)
    for name in ("rgb", "alpha"):
        difference = (getattr(got, name) - getattr(expected, name)).abs()
        assert difference.max() < largest, name
        assert difference.mean() < 2e-6, name
    clear = expected.alpha > 1e-2
    assert torch.equal(torch.isinf(got.depth)[clear], torch.isinf(expected.depth)[clear])
    apart = (got.depth - expected.depth)[clear].abs()
    assert (apart <= largest / expected.alpha[clear] + rounding * expected.depth[clear]).all()
    decided = (got.alpha - 0.5).abs() > 2 * largest
    both = decided & torch.isfinite(expected.first_hit)
    assert torch.equal(torch.isinf(got.first_hit)[decided], torch.isinf(expected.first_hit)[decided])
    # A sum that stands at 0.5 to rounding may reach it one sample later.
    late = (got.first_hit - expected.first_hit)[both].abs() > 1e-6 + rounding * expected.first_hit[both]
    assert late.double().mean() < 0.01 if both.any() else True


def assert_same_direction_and_length(got: Tensor, expected: Tensor, name: object) -> None:
    """Direction to a cosine of 0.9999, length to a thousandth."""
    got, norm = got.double(), expected.norm()
    assert float((got * expected).sum() / (got.norm() * norm)) >= 0.9999, name
    assert abs(float(got.norm() / norm) - 1) <= 1e-3, name
