"""Scenes nobody thought of: the fast marcher against the readable one in float64, values and gradients."""

import functools
import math
from typing import NamedTuple

import pytest
import torch
from march_scenes import FACE_STEP, assert_same_direction_and_length, gradients, objective
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.rotation import axis_angle_to_matrix
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.cpu.march import march_cpu
from primdiffusion.render.image import Rendering
from primdiffusion.render.lattice import MarchSettings, Span
from primdiffusion.render.reference import march_reference
from torch import Tensor

LATTICES = ((4, 2, 1), (1,), (2, 1), (4,), (6, 3, 1))
PICTURES = ((24, 20), (1, 1), (3, 37), (40, 1), (1, 33), (17, 9))


class Scene(NamedTuple):
    """Arguments of a marcher."""

    boxes: Primitives
    camera: Camera
    settings: MarchSettings
    span: Span | None

    def to(self, dtype: torch.dtype) -> "Scene":
        span = None if self.span is None else self.span.to(dtype=dtype)
        return Scene(self.boxes.to(dtype=dtype), self.camera.to(dtype=dtype), self.settings, span)


def random_scene(seed: int) -> Scene:
    """Any number of boxes of any size and shape, thin to opaque, full to sparse, some flat, seen from anywhere."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    def between(low: float, high: float) -> float:
        return low + (high - low) * float(uniform(1))

    def one_of(choices):
        return choices[int(torch.randint(len(choices), (1,), generator=generator))]

    count, size = one_of((1, 2, 3, 7, 13, 31)), one_of((8, 8, 8, 1, 2, 3, 5, 9))
    unit = 10 ** between(-3, 1)
    half_extent = unit * (0.05 + one_of((0.1, 0.6, 1.5)) * uniform(count, 3))
    half_extent[:, 0] *= one_of((1.0, 1.0, 0.01))
    half_extent[0] *= one_of((1.0, 1.0, 1.0, 0.0, -1.0))
    density = 10 ** between(-2, 2.5) / unit * uniform(count, size, size, size)
    axes = axis_angle_to_matrix(one_of((3.0, 3.0, 0.0)) * (uniform(count, 3) * 2 - 1))
    boxes = Primitives(
        position=(uniform(count, 3) * 2 - 1) * unit * one_of((0.0, 0.3, 1.0)),
        rotation=axes * torch.tensor([one_of((1.0, -1.0)), 1.0, 1.0], dtype=torch.float64),
        half_extent=half_extent,
        rgb=one_of((1.0, 4.0)) * uniform(count, 3, size, size, size) - one_of((0.0, 1.0)),
        density=density * (uniform(count, size, size, size) > one_of((0.0, 0.7, 0.95))),
    )
    width, height = one_of(PICTURES)
    distance = unit * one_of((0.01, 0.3, 1.0, 3.0, 30.0))
    eye = distance * torch.nn.functional.normalize(uniform(3) * 2 - 1, dim=0)
    fov = one_of((0.1, 0.6, 2.5)) if distance < 5 * unit else 2 * unit / distance
    camera = look_at(
        eye, 0.1 * unit * (uniform(3) - 2), vertical_fov=fov, width=width, height=height, up=(0.1, 1.0, 0.05)
    )
    camera.intrinsics[0, 1] = one_of((0.0, 5.0))
    near = uniform(height, width) * distance
    far = near + unit * one_of((1.0, 3.0)) * uniform(height, width)
    far[uniform(height, width) > 0.8] = math.inf
    settings = MarchSettings(
        step=unit * one_of((0.02, 0.1, 0.3)),
        strides=one_of(LATTICES),
        samples_per_voxel=one_of((0.5, 1.0, 2.0)),
        compositing=one_of(("mixed", "mixed", "index_order")),
    )
    return Scene(boxes, camera, settings, one_of((None, Span(near, far))))


def render(march, scene: Scene) -> Rendering:
    return march(scene.boxes, scene.camera, scene.settings, scene.span)


without_depth = functools.partial(objective, depth=False)


@pytest.mark.parametrize("start", range(0, 200, 50))
def test_pictures_of_random_scenes_agree(start):
    seen = 0
    for seed in range(start, start + 50):
        scene = random_scene(seed).to(torch.float32)
        exact, got = render(march_reference, scene.to(torch.float64)), render(march_cpu, scene).to(dtype=torch.float64)
        sample = min(float(scene.boxes.density.max()) * scene.settings.step, 1)
        largest = 2e-5 + 2 * FACE_STEP * sample * max(float(scene.boxes.rgb.abs().max()), 1)
        for name in ("rgb", "alpha"):
            assert (getattr(got, name) - getattr(exact, name)).abs().max() < largest, (seed, name)
        clear = exact.alpha > 0.01
        late = 2 * largest / exact.alpha[clear] * float(scene.settings.step) + 1e-6 * exact.depth[clear]
        assert ((got.depth - exact.depth)[clear].abs() <= late + 1e-3 * scene.settings.step).all(), seed
        seen += bool(clear.any())
    assert seen > 15


def test_gradients_of_random_scenes_agree():
    """Of colour and opacity, for each input."""
    seen = 0
    for seed in range(1000, 1060):
        scene = random_scene(seed).to(torch.float32)
        exact, got = (
            gradients(lambda b, c, s=one, m=march: m(b, c, s.settings, s.span), one.boxes, one.camera, without_depth)
            for march, one in ((march_reference, scene.to(torch.float64)), (march_cpu, scene))
        )
        for name, gradient in exact.items():
            if gradient.norm() == 0:
                assert got[name].norm() == 0, (seed, name)
            else:
                assert_same_direction_and_length(got[name], gradient, (seed, name))
        seen += bool(exact["position"].norm() > 0)
    assert seen > 20
