"""Sample positions along rays: one lattice for all rays and boxes, sampled with a stride for each box (SPEC 4)."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from typing import Annotated, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.formats.requests import RAY_STEP, Positive
from primdiffusion.formats.schema import Checked, Length, Range
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import Primitives

Compositing = Literal["mixed", "index_order"]
"""Compositing of overlapping boxes at a lattice point (SPEC 4): mixed by opacity, or by index, lowest first."""

ORTHOGONAL = 1e-2
"""Largest entry of |R^T R - 1| accepted as rounding of a rotation."""
NEARLY_ORTHOGONAL = 5e-2
"""The same for cameras, which an optimiser may have changed; a camera that scales shifts the origin of its rays."""
LARGEST_STRIDE = 2**20
"""Lattice points; a finer lattice exceeds the precision of float32."""
MOST_POINTS = 2**24
"""Limit on the lattice points across a box; more suggest wrong units and would take hours."""


@dataclasses.dataclass(frozen=True)
class MarchSettings(Checked):
    """Sampling of rays.

    The lattice is t_n = n * spacing, n = 1, 2, ..., metres along the ray, the same for all rays and boxes. A box of
    stride s is sampled where s divides n, and each of its samples covers s * spacing of the ray. The stride is the
    largest with at least `samples_per_voxel` samples along the box's shortest voxel edge 2 * min(half_extent) / 7, or
    the smallest stride for finer boxes.
    """

    step: Positive = RAY_STEP
    """Distance between the samples of the largest boxes, metres: the largest stride times the spacing."""
    strides: Annotated[tuple[Annotated[int, Range(1, LARGEST_STRIDE)], ...], Length(1)] = (4, 2, 1)
    """Strides in descending order; each divides the previous one."""
    samples_per_voxel: Positive = 2.0
    """Smallest number of samples along the shortest edge of a voxel."""
    compositing: Compositing = "mixed"
    """"mixed" is independent of the order of the boxes; the released code uses "index_order"."""
    pixel_centre: float = 0.5
    """Position of the ray within the pixel; 0 in the released code. Applied by `march`, not by the back ends."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(a <= b or a % b for a, b in pairwise(self.strides)):
            raise ValueError(
                f"strides are {self.strides}: give them in descending order, each a divisor of the previous one, such "
                "as (4, 2, 1)"
            )

    @property
    def spacing(self) -> float:
        """Distance between neighbouring lattice points, metres."""
        return self.step / self.strides[0]


UNIFORM_MILLIMETRE = MarchSettings(step=0.001, strides=(1,))
"""Samples every millimetre in all boxes: the released code's sampling, and a slow reference for the default."""

RELEASED = dataclasses.replace(UNIFORM_MILLIMETRE, compositing="index_order", pixel_centre=0.0)
"""Settings of the released code (SPEC 4): every millimetre, boxes in index order, rays through pixel corners."""


@dataclasses.dataclass(frozen=True)
class Span(TensorRecord):
    """The part of each ray to march: lattice points with near <= t <= far, metres along the ray.

    Not differentiable. Far may be infinite; an empty span gives an empty pixel.
    """

    near: Float[Tensor, "*b height width"]
    far: Float[Tensor, "*b height width"]


def strides_of(primitives: Primitives, settings: MarchSettings) -> Int[Tensor, "k"]:
    """Each box's stride in lattice points (see `MarchSettings`).

    Raises ValueError if a ray could have more than MOST_POINTS samples in one box.
    """
    voxel = 2 * primitives.half_extent.detach().amin(-1) / max(primitives.density.shape[-1] - 1, 1)
    stride = torch.full(voxel.shape, settings.strides[-1], dtype=torch.int64, device=voxel.device)
    for candidate in reversed(settings.strides):
        stride[voxel >= candidate * settings.spacing * settings.samples_per_voxel] = candidate
    points = 2 * primitives.half_extent.detach().amax(-1) / (stride * settings.spacing) * (voxel > 0)
    if len(points) and float(points.max()) > MOST_POINTS:
        raise ValueError(
            f"box {int(points.argmax())} has half extents {primitives.half_extent[points.argmax()].tolist()} m: a ray "
            f"would take {float(points.max()):.2g} samples in it; choose a larger step, or check the scale of the human"
        )
    return stride


def check_scene(primitives: Primitives, camera: Camera, span: Span | None = None) -> None:
    """Raise ValueError, naming the field, for wrong shapes, devices, values that are not finite or invalid cameras.

    Leading dimensions are free. Rotations may reflect, which mirrors the contents of the box, but not shear.
    """
    k, s = primitives.position.shape[-2] if primitives.position.ndim > 1 else -1, primitives.density.shape[-1]
    shapes = {"position": (k, 3), "rotation": (k, 3, 3), "half_extent": (k, 3)}
    shapes |= {"rgb": (k, 3, s, s, s), "density": (k, s, s, s)}
    for name, shape in shapes.items():
        value: Tensor = getattr(primitives, name)
        if tuple(value.shape[-len(shape) :]) != shape:
            raise ValueError(f"primitives.{name} has shape {tuple(value.shape)}; it must end in {shape}")
        if not torch.isfinite(value).all():
            raise ValueError(f"primitives.{name} holds NaN or infinite values; pose or generate the human again")
    if bool((primitives.density < 0).any()):
        raise ValueError(
            f"the smallest density is {float(primitives.density.min()):.4g} per metre; clamp it to 0 or more"
        )
    _check_rotation(primitives.rotation)
    check_camera(camera)
    check_one_device(primitives, camera, span)
    if span is not None:
        _check_span(span, camera)


def check_camera(camera: Camera) -> None:
    """Raise ValueError, naming the field, for a camera without pixels, or that is singular or not rigid."""
    for name, shape in (("intrinsics", (3, 3)), ("world_to_camera", (3, 4))):
        value = getattr(camera, name)
        if tuple(value.shape[-2:]) != shape:
            raise ValueError(f"camera.{name} has shape {tuple(value.shape)}; it must end in {shape}")
        if not torch.isfinite(value).all():
            raise ValueError(f"camera.{name} holds NaN or infinite values: {value.tolist()}; use look_at")
    focal = camera.intrinsics.detach()[..., [0, 1], [0, 1]]
    if not torch.isfinite(1 / focal).all():
        raise ValueError(f"the camera's focal lengths are {focal.tolist()} pixels: they must not be 0")
    if _off_orthogonal(camera.world_to_camera[..., :3]).gt(NEARLY_ORTHOGONAL).any():
        raise ValueError(
            f"camera.world_to_camera {camera.world_to_camera.tolist()} scales or shears: it must be a rotation "
            "and translation; use look_at"
        )
    if camera.width < 1 or camera.height < 1:
        raise ValueError(f"the image has {camera.width} x {camera.height} pixels; both sides must be at least 1")


def check_unbatched(primitives: Primitives, camera: Camera, span: Span | None = None) -> None:
    """Raise ValueError unless there is one set of boxes and one view; `march` takes batches."""
    tensors = [primitives.position[..., 0], camera.intrinsics[..., 0], camera.world_to_camera[..., 0]]
    if any(tensor.ndim != 1 for tensor in tensors) or (span is not None and span.near.ndim != 2):
        shapes = [tuple(tensor.shape[:-1]) for tensor in tensors]
        raise ValueError(f"the primitives and the camera have leading dimensions {shapes}: give a batch to `march`")


def check_one_device(*records: TensorRecord | None) -> None:
    """Raise ValueError if tensors are on several devices."""
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
            f"primitives.rotation of box {int(excess.flatten().argmax())} is not a rotation: R^T R differs from the "
            f"identity by {float(excess.max()):.3g}; apply scale to half_extent and shear to the mesh"
        )


def _check_span(span: Span, camera: Camera) -> None:
    for name in ("near", "far"):
        value: Tensor = getattr(span, name)
        if tuple(value.shape[-2:]) != (camera.height, camera.width):
            raise ValueError(
                f"span.{name} has shape {tuple(value.shape)}; it must end in the image size "
                f"({camera.height}, {camera.width})"
            )
        if torch.isnan(value).any():
            raise ValueError(f"span.{name} holds NaN; use 0 and infinity for no limit")
