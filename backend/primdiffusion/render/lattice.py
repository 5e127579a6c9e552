"""Where rays are sampled: one lattice for all rays and boxes, taken in strides that fit each box (SPEC 4)."""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Int
from torch import Tensor

from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives

WINDOW_SHARPNESS = 8.0
WINDOW_POWER = 8
"""The window exp(-8 * sum |y|^8) fades a box's density towards its faces; payloads are made for it: no setting."""


@dataclasses.dataclass(frozen=True)
class MarchSettings:
    """How finely rays are sampled.

    The lattice is t_n = n * spacing, n = 1, 2, ..., metres along the ray, the same for all rays and boxes. A box of
    stride s is sampled where s divides n, and each of its samples stands for s * spacing of the ray. The stride is the
    largest one that leaves `samples_per_voxel` samples on the box's shortest voxel edge 2 * min(half_extent) / 7, or
    the smallest stride for boxes finer than that.
    """

    step: float = 0.004
    """Distance between the samples of the largest boxes, metres: the largest stride times the spacing."""
    strides: tuple[int, ...] = (4, 2, 1)
    """Falling; each divides the one before it."""
    samples_per_voxel: float = 2.0
    """Samples wanted on the shortest edge of a voxel."""

    def __post_init__(self) -> None:
        if not self.step > 0:
            raise ValueError(f"the step is {self.step} m; it must be positive")
        if not self.samples_per_voxel > 0:
            raise ValueError(f"samples_per_voxel is {self.samples_per_voxel}; it must be positive")
        pairs = zip(self.strides, self.strides[1:], strict=False)
        if not self.strides or self.strides[-1] < 1 or any(a <= b or a % b for a, b in pairs):
            raise ValueError(f"strides {self.strides} must fall and each divide the one before it, as (4, 2, 1) do")

    @property
    def spacing(self) -> float:
        """Distance between neighbouring lattice points, metres."""
        return self.step / self.strides[0]


UNIFORM_MILLIMETRE = MarchSettings(step=0.001, strides=(1,))
"""Every box at every millimetre: the released code's sampling, and slow truth for the default."""


def strides_of(primitives: Primitives, settings: MarchSettings) -> Int[Tensor, "k"]:
    """Each box's stride in lattice points (see `MarchSettings`)."""
    voxel = 2 * primitives.half_extent.detach().amin(-1) / max(primitives.density.shape[-1] - 1, 1)
    stride = torch.full(voxel.shape, settings.strides[-1], dtype=torch.int64, device=voxel.device)
    for candidate in reversed(settings.strides):
        stride[voxel >= candidate * settings.spacing * settings.samples_per_voxel] = candidate
    return stride


def check_scene(primitives: Primitives, camera: Camera) -> None:
    """ValueError, naming the field, unless the boxes are one unbatched, finite set and the picture has pixels."""
    k, s = primitives.position.shape[0], primitives.density.shape[-1]
    shapes = {"position": (k, 3), "rotation": (k, 3, 3), "half_extent": (k, 3)}
    shapes |= {"rgb": (k, 3, s, s, s), "density": (k, s, s, s)}
    for name, shape in shapes.items():
        value: Tensor = getattr(primitives, name)
        if tuple(value.shape) != shape:
            raise ValueError(
                f"primitives.{name} has shape {tuple(value.shape)}, not {shape}: march one person at a time"
            )
        if not torch.isfinite(value).all():
            raise ValueError(f"primitives.{name} holds NaN or infinite values; pose or generate the person again")
    if bool((primitives.density < 0).any()):
        raise ValueError(f"density falls to {float(primitives.density.min()):.4g} per metre; clamp it to 0 or more")
    for name in ("intrinsics", "world_to_camera"):
        if not torch.isfinite(getattr(camera, name)).all():
            raise ValueError(
                f"camera.{name} holds NaN or infinite values: {getattr(camera, name).tolist()}; look_at makes one"
            )
    if camera.width < 1 or camera.height < 1:
        raise ValueError(f"the picture is {camera.width} x {camera.height} pixels; both sides must be at least 1")
