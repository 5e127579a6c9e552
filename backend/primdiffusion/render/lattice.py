"""Where rays are sampled: one lattice for all rays and boxes, taken in strides that fit each box (SPEC 4)."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal, get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.formats.requests import RAY_STEP
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import Primitives

Compositing = Literal["mixed", "index_order"]
"""How boxes that share a lattice point share what is left of a ray (SPEC 4): by opacity, or lower index first."""

ORTHOGONAL = 1e-2
"""Largest entry of R^T R - 1 that passes as rounding of a rotation."""
NEARLY_ORTHOGONAL = 5e-2
"""The same of a camera, which an optimiser may have moved; the rays of one that scales start in the wrong place."""
LARGEST_STRIDE = 2**20
"""Lattice points; more would make a lattice finer than float32 tells boxes apart."""
MOST_POINTS = 2**24
"""Lattice points through one box: more are a slip of units and would take hours."""


@dataclasses.dataclass(frozen=True)
class MarchSettings:
    """How finely rays are sampled.

    The lattice is t_n = n * spacing, n = 1, 2, ..., metres along the ray, the same for all rays and boxes. A box of
    stride s is sampled where s divides n, and each of its samples stands for s * spacing of the ray. The stride is the
    largest one that leaves `samples_per_voxel` samples on the box's shortest voxel edge 2 * min(half_extent) / 7, or
    the smallest stride for boxes finer than that.
    """

    step: float = RAY_STEP
    """Distance between the samples of the largest boxes, metres: the largest stride times the spacing."""
    strides: tuple[int, ...] = (4, 2, 1)
    """Falling; each divides the one before it."""
    samples_per_voxel: float = 2.0
    """Samples wanted on the shortest edge of a voxel."""
    compositing: Compositing = "mixed"
    """Ours is "mixed", which no order of the boxes changes; the released code's is "index_order"."""
    pixel_centre: float = 0.5
    """Where in a pixel its ray passes; the released code's is 0. Applied by `march`, not by the back ends."""

    def __post_init__(self) -> None:
        if not (self.step > 0 and math.isfinite(self.step)):
            raise ValueError(f"the step is {self.step} m; it must be positive and finite")
        if self.compositing not in get_args(Compositing):
            raise ValueError(f"compositing is {self.compositing!r}; choose from {get_args(Compositing)}")
        if not self.samples_per_voxel > 0:
            raise ValueError(f"samples_per_voxel is {self.samples_per_voxel}; it must be positive")
        if not math.isfinite(self.pixel_centre):
            raise ValueError(f"pixel_centre is {self.pixel_centre}; 0.5 is the middle of a pixel, 0 its corner")
        whole = all(isinstance(stride, int) and 1 <= stride <= LARGEST_STRIDE for stride in self.strides)
        pairs = zip(self.strides, self.strides[1:], strict=False)
        if not self.strides or not whole or any(a <= b or a % b for a, b in pairs):
            raise ValueError(
                f"strides {self.strides} must fall and each divide the one before it, as (4, 2, 1) do: whole numbers "
                f"from 1 to {LARGEST_STRIDE}"
            )

    @property
    def spacing(self) -> float:
        """Distance between neighbouring lattice points, metres."""
        return self.step / self.strides[0]


UNIFORM_MILLIMETRE = MarchSettings(step=0.001, strides=(1,))
"""Every box at every millimetre: the released code's sampling, and slow truth for the default."""

RELEASED = dataclasses.replace(UNIFORM_MILLIMETRE, compositing="index_order", pixel_centre=0.0)
"""As the released code draws (SPEC 4): every millimetre, boxes in index order, rays through the pixels' corners."""


@dataclasses.dataclass(frozen=True)
class Span(TensorRecord):
    """The part of each ray that is drawn: lattice points with near <= t <= far, metres along the ray.

    Not differentiable. Far may be infinite; a span that is empty leaves its pixel empty.
    """

    near: Float[Tensor, "*b height width"]
    far: Float[Tensor, "*b height width"]


def strides_of(primitives: Primitives, settings: MarchSettings) -> Int[Tensor, "k"]:
    """Each box's stride in lattice points (see `MarchSettings`).

    Raises ValueError where a ray would meet more than MOST_POINTS samples in one box.
    """
    voxel = 2 * primitives.half_extent.detach().amin(-1) / max(primitives.density.shape[-1] - 1, 1)
    stride = torch.full(voxel.shape, settings.strides[-1], dtype=torch.int64, device=voxel.device)
    for candidate in reversed(settings.strides):
        stride[voxel >= candidate * settings.spacing * settings.samples_per_voxel] = candidate
    points = 2 * primitives.half_extent.detach().amax(-1) / (stride * settings.spacing) * (voxel > 0)
    if len(points) and float(points.max()) > MOST_POINTS:
        raise ValueError(
            f"box {int(points.argmax())} has half extents {primitives.half_extent[points.argmax()].tolist()} m: a ray "
            f"would take {float(points.max()):.2g} samples in it; choose a larger step, or check the person's scale"
        )
    return stride


def check_scene(primitives: Primitives, camera: Camera, span: Span | None = None) -> None:
    """ValueError, naming the field, unless all is finite, of one size and one device, and the camera is one.

    Leading dimensions are free. Rotations may reflect (the box's contents are then mirrored), but not shear.
    """
    k, s = primitives.position.shape[-2] if primitives.position.ndim > 1 else -1, primitives.density.shape[-1]
    shapes = {"position": (k, 3), "rotation": (k, 3, 3), "half_extent": (k, 3)}
    shapes |= {"rgb": (k, 3, s, s, s), "density": (k, s, s, s)}
    for name, shape in shapes.items():
        value: Tensor = getattr(primitives, name)
        if tuple(value.shape[-len(shape) :]) != shape:
            raise ValueError(f"primitives.{name} has shape {tuple(value.shape)}; it must end in {shape}")
        if not torch.isfinite(value).all():
            raise ValueError(f"primitives.{name} holds NaN or infinite values; pose or generate the person again")
    if bool((primitives.density < 0).any()):
        raise ValueError(f"density falls to {float(primitives.density.min()):.4g} per metre; clamp it to 0 or more")
    _check_rotation(primitives.rotation)
    check_camera(camera)
    check_one_device(primitives, camera, span)
    if span is not None:
        _check_span(span, camera)


def check_camera(camera: Camera) -> None:
    """ValueError, naming the field, unless the picture has pixels and every pixel a ray from the camera's place."""
    for name, shape in (("intrinsics", (3, 3)), ("world_to_camera", (3, 4))):
        value = getattr(camera, name)
        if tuple(value.shape[-2:]) != shape:
            raise ValueError(f"camera.{name} has shape {tuple(value.shape)}; it must end in {shape}")
        if not torch.isfinite(value).all():
            raise ValueError(f"camera.{name} holds NaN or infinite values: {value.tolist()}; look_at makes one")
    focal = camera.intrinsics.detach()[..., [0, 1], [0, 1]]
    if not torch.isfinite(1 / focal).all():
        raise ValueError(f"the camera's focal lengths are {focal.tolist()} pixels: give ones other than 0")
    if _off_orthogonal(camera.world_to_camera[..., :3]).gt(NEARLY_ORTHOGONAL).any():
        raise ValueError(
            f"camera.world_to_camera {camera.world_to_camera.tolist()} scales or shears: a camera only turns and "
            "moves; look_at makes one"
        )
    if camera.width < 1 or camera.height < 1:
        raise ValueError(f"the picture is {camera.width} x {camera.height} pixels; both sides must be at least 1")


def check_unbatched(primitives: Primitives, camera: Camera, span: Span | None = None) -> None:
    """ValueError unless this is one set of boxes and one view; `march` takes batches."""
    given = [primitives.position[..., 0], camera.intrinsics[..., 0], camera.world_to_camera[..., 0]]
    if any(tensor.ndim != 1 for tensor in given) or (span is not None and span.near.ndim != 2):
        shapes = [tuple(tensor.shape[:-1]) for tensor in given]
        raise ValueError(f"the primitives and the camera have leading dimensions {shapes}: give a batch to `march`")


def check_one_device(*records: TensorRecord | None) -> None:
    """ValueError where tensors lie on several devices."""
    fields = [value for record in records if record is not None for value in vars(record).values()]
    devices = {str(value.device) for value in fields if isinstance(value, Tensor)}
    if len(devices) > 1:
        raise ValueError(f"primitives, camera and span lie on {sorted(devices)}: move them to one device with .to()")


def _off_orthogonal(matrix: Tensor) -> Tensor:
    """The largest entry of M^T M - 1 of each matrix."""
    product = matrix.detach().mT @ matrix.detach()
    return (product - torch.eye(3, dtype=product.dtype, device=product.device)).abs().amax((-2, -1))


def _check_rotation(rotation: Tensor) -> None:
    excess = _off_orthogonal(rotation)
    if excess.numel() and float(excess.max()) > ORTHOGONAL:
        raise ValueError(
            f"primitives.rotation is no rotation in box {int(excess.flatten().argmax())}: R^T R is off the identity by "
            f"{float(excess.max()):.3g}; put scale into half_extent and shear into the mesh before frames are attached"
        )


def _check_span(span: Span, camera: Camera) -> None:
    for name in ("near", "far"):
        value: Tensor = getattr(span, name)
        if tuple(value.shape[-2:]) != (camera.height, camera.width):
            raise ValueError(
                f"span.{name} has shape {tuple(value.shape)}; it must end in the picture's ({camera.height}, "
                f"{camera.width})"
            )
        if torch.isnan(value).any():
            raise ValueError(f"span.{name} holds NaN; use 0 and infinity where there is no limit")
