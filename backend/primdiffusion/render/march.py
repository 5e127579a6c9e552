"""The marcher: render primitives from a camera (SPEC 4; paper sec. 3.1, "Efficient Decoder-free Rendering")."""

from __future__ import annotations

import dataclasses
from typing import TypeVar

import torch

from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render import cuda
from primdiffusion.render.cpu.march import march_cpu
from primdiffusion.render.image import Rendering
from primdiffusion.render.lattice import RELEASED, MarchSettings, Span, check_camera, check_one_device
from primdiffusion.render.reference import march_reference

Record = TypeVar("Record", bound=TensorRecord)

__all__ = ["RELEASED", "MarchSettings", "Rendering", "Span", "march"]


def march(
    primitives: Primitives,
    camera: Camera,
    settings: MarchSettings = MarchSettings(),  # noqa: B008
    *,
    span: Span | None = None,
) -> Rendering:
    """Render `primitives` from `camera`: premultiplied linear rgb, alpha and depths (metres), [*b, H, W].

    The leading dimensions of primitives, camera and span broadcast to *b: humans [p, 1] and cameras [v] give images
    [p, v, H, W]. Several humans in one image form one set of boxes (`Primitives.together`). `march_reference` defines
    the rule; the settings `RELEASED` reproduce the released code. Rotations that reflect mirror the contents of a box;
    boxes with an extent of zero or less are not rendered.

        >>> image = pd.march(boxes, camera)
        >>> image.save("anna.png")  # transparent; over a colour: image.over((1.0, 1.0, 1.0))

    Differentiable in every tensor except the span. float32 runs on the fast back end of its device (`march_cpu`, or
    `march_cuda` if Triton is installed; for Apple GPUs `march_cpu`), everything else on `march_reference`, which is
    slow. Raises ValueError as `check_scene` does, and if leading dimensions do not broadcast.
    """
    check_one_device(primitives, camera, span)
    if _borrows_cpu(primitives.position.device):
        limits = None if span is None else span.to("cpu")
        rendering = march(primitives.to("cpu"), camera.to("cpu"), settings, span=limits)
        return rendering.to(primitives.position.device)
    if camera.intrinsics.device.type == "cpu":  # on GPUs the kernels check it, as reading it here would synchronise
        check_camera(camera)
    if settings.pixel_centre != 0.5:
        shift = 0.5 - settings.pixel_centre
        camera = camera.moved_in_picture(shift, shift)
    batch = _batch_shape(primitives, camera, span)
    if cuda.available(primitives.position.device) and cuda.supports(primitives, camera):
        return _march_at_once(primitives, camera, settings, span, batch)
    return _march_one_by_one(primitives, camera, settings, span, batch)


def _borrows_cpu(device: torch.device) -> bool:
    return device.type == "mps"  # no back end of its own, and no float64


def _march_one_by_one(
    primitives: Primitives, camera: Camera, settings: MarchSettings, span: Span | None, batch: torch.Size
) -> Rendering:
    tensors = [*vars(primitives).values(), camera.intrinsics, camera.world_to_camera]
    plain = all(tensor.dtype == torch.float32 and tensor.device.type == "cpu" for tensor in tensors)
    draw = march_cpu if plain else march_reference
    boxes = _unbound(primitives, PRIMITIVE_DIMENSIONS, batch)
    views = _unbound(camera, CAMERA_DIMENSIONS, batch)
    spans = [None] * len(views) if span is None else _unbound(span, SPAN_DIMENSIONS, batch)
    return _stacked(
        [draw(person, view, settings, limits) for person, view, limits in zip(boxes, views, spans, strict=True)], batch
    )


def _march_at_once(
    primitives: Primitives, camera: Camera, settings: MarchSettings, span: Span | None, batch: torch.Size
) -> Rendering:
    """Render all images with one call of `march_cuda`, without copying a single human seen in all of them."""
    from primdiffusion.render.cuda.march import march_cuda  # Triton is optional

    people = _leading(primitives, PRIMITIVE_DIMENSIONS)
    pictures = march_cuda(
        _flat(primitives, PRIMITIVE_DIMENSIONS, batch if people.numel() > 1 else people),
        _flat(camera, CAMERA_DIMENSIONS, batch),
        settings,
        None if span is None else _flat(span, SPAN_DIMENSIONS, batch),
    )
    return pictures.map(lambda tensor: tensor.unflatten(0, tuple(batch)) if batch else tensor[0])


PRIMITIVE_DIMENSIONS = {"position": 2, "rotation": 3, "half_extent": 2, "rgb": 5, "density": 4}
CAMERA_DIMENSIONS = {"intrinsics": 2, "world_to_camera": 2}
SPAN_DIMENSIONS = {"near": 2, "far": 2}
"""Dimensions of each unbatched field."""


def _leading(record: TensorRecord, dimensions: dict[str, int]) -> torch.Size:
    """Batch shape of a record. Raises ValueError if its fields do not broadcast."""
    shapes = [tuple(getattr(record, name).shape) for name in dimensions]
    if any(len(shape) < count for shape, count in zip(shapes, dimensions.values(), strict=True)):
        actual = dict(zip(dimensions, shapes, strict=True))
        raise ValueError(f"{type(record).__name__} has shapes {actual}; its fields need {dimensions} dimensions")
    leads = [shape[: len(shape) - count] for shape, count in zip(shapes, dimensions.values(), strict=True)]
    try:
        return torch.broadcast_shapes(*leads)
    except RuntimeError:
        actual = dict(zip(dimensions, shapes, strict=True))
        raise ValueError(f"the leading dimensions of {type(record).__name__} do not broadcast: {actual}") from None


def _batch_shape(primitives: Primitives, camera: Camera, span: Span | None) -> torch.Size:
    leads = [_leading(primitives, PRIMITIVE_DIMENSIONS), _leading(camera, CAMERA_DIMENSIONS)]
    if span is not None:
        leads.append(_leading(span, SPAN_DIMENSIONS))
    try:
        batch = torch.broadcast_shapes(*leads)
    except RuntimeError:
        named = ", ".join(str(tuple(lead)) for lead in leads)
        raise ValueError(
            f"the leading dimensions of primitives, camera and span, {named}, do not broadcast: humans [p, 1] and "
            "cameras [v] give images [p, v]"
        ) from None
    if 0 in batch:
        raise ValueError(f"a batch of {tuple(batch)} is empty: give at least one human and one camera")
    return batch


def _unbound(record: Record, dimensions: dict[str, int], batch: torch.Size) -> list[Record]:
    """Split into one unbatched record per image; images that share a record get the same object."""
    lead = _leading(record, dimensions)
    if not lead:
        return [record] * batch.numel()
    # unbind instead of indexing: its gradient is one stack, not a batch of zeros for each record.
    fields = {
        name: getattr(record, name).expand(*lead, *getattr(record, name).shape[-count:]).flatten(0, len(lead) - 1)
        for name, count in dimensions.items()
    }
    singles = [
        dataclasses.replace(record, **dict(zip(fields, values, strict=True)))
        for values in zip(*(field.unbind(0) for field in fields.values()), strict=True)
    ]
    index = torch.arange(len(singles)).reshape(lead).expand(batch).flatten()
    return [singles[i] for i in index.tolist()]


def _flat(record: Record, dimensions: dict[str, int], batch: torch.Size) -> Record:
    """Broadcast the record to `batch`, flattened to one leading dimension."""
    fields = {}
    for name, count in dimensions.items():
        value = getattr(record, name)
        own = value.shape[value.ndim - count :]
        fields[name] = value.expand(*batch, *own).reshape(-1, *own)
    return dataclasses.replace(record, **fields)


def _stacked(pictures: list[Rendering], batch: torch.Size) -> Rendering:
    if not batch:
        return pictures[0]
    names = [field.name for field in dataclasses.fields(Rendering)]
    return Rendering(
        **{name: torch.stack([getattr(p, name) for p in pictures]).unflatten(0, tuple(batch)) for name in names}
    )
