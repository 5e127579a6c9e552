"""The fast marcher for CPUs: numba, float32, differentiable; the same rule as `reference.py` (SPEC 4).

Pixels are processed in tiles, each with the boxes whose projection overlaps it. A ray is tested against its tile's
boxes, accumulates opacity and colour over a chunk of lattice points, composites the chunk, and stops when opaque.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy import ndarray
from torch import Tensor

from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.cpu.adjoint import Gradients, Upstream, adjoin_boxes, weigh_rays
from primdiffusion.render.cpu.compiled import on_all_threads
from primdiffusion.render.cpu.forward import ImageRows, SaturationPoints, march_tiles
from primdiffusion.render.cpu.packing import PackedScene, heaviest_first, pack
from primdiffusion.render.image import Rendering
from primdiffusion.render.lattice import MarchSettings, Span, check_camera, check_scene, check_unbatched, strides_of

LARGEST_PAYLOAD = 256
"""Voxels along each side; cell indices are float32, exact below 2^24."""


@dataclasses.dataclass(frozen=True)
class SampleCount:
    """Number of samples of an image."""

    inside_boxes: int
    """Samples by the rule (SPEC 4): lattice points in boxes, at each box's stride, until rays become opaque."""
    evaluated: int
    """Samples evaluated by `march_cpu`: empty cells are skipped, but the last chunk of an opaque ray is completed."""


def march_cpu(
    primitives: Primitives,
    camera: Camera,
    settings: MarchSettings = MarchSettings(),  # noqa: B008
    span: Span | None = None,
) -> Rendering:
    """Same as `march_reference`, in float32 on the CPU on all processors.

    Differentiable, once, in every tensor of `primitives` and `camera`, from rgb, alpha and depth. The first call on a
    machine compiles (some 10 s, the first backward pass as much again); the result is cached on disk. Memory beyond the
    inputs: as much again as rgb and density, and some 50 bytes a pixel. Raises ValueError as `march_reference` does.
    """
    view = _view(primitives, camera, settings, span)
    inputs = (primitives.rgb.float(), primitives.density.float(), view.to_local, view.offset, view.pixel_to_world)
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs):
        fields = _March.apply(*inputs, view)
    else:
        fields = _draw(view, _scene(view, inputs, empty_cells=False), _ends(0))
    return Rendering(*(field.unflatten(0, (camera.height, camera.width)) for field in fields))


def count_samples(
    primitives: Primitives,
    camera: Camera,
    settings: MarchSettings = MarchSettings(),  # noqa: B008
    span: Span | None = None,
) -> SampleCount:
    """Count the samples of `march_cpu` and of the rule; takes as long as two images."""
    view = _view(primitives, camera, settings, span)
    inputs = (primitives.rgb.float(), primitives.density.float(), view.to_local, view.offset, view.pixel_to_world)
    counts = []
    for empty_cells in (True, False):
        scene = _scene(view, inputs, empty_cells=empty_cells)
        counts.append(np.zeros((len(scene.tile_boxes), 2), np.int64))
        _draw(view, scene, _ends(camera.width * camera.height), counts[-1])
    return SampleCount(inside_boxes=int(counts[0][:, 1].sum()), evaluated=int(counts[1][:, 0].sum()))


def draw_with_ends(
    primitives: Primitives, camera: Camera, settings: MarchSettings
) -> tuple[Rendering, _View, PackedScene, SaturationPoints]:
    """Render without gradients; also return the scene with empty cells and the ends of the rays, for derivatives."""
    view = _view(primitives.map(lambda tensor: tensor.detach()), camera, settings, None)
    inputs = (primitives.rgb.float(), primitives.density.float(), view.to_local, view.offset, view.pixel_to_world)
    ends = _ends(camera.width * camera.height)
    fields = _draw(view, _scene(view, inputs, empty_cells=False), ends)
    rendering = Rendering(*(field.unflatten(0, (camera.height, camera.width)) for field in fields))
    return rendering, view, _scene(view, inputs, empty_cells=True), ends


class _View(NamedTuple):
    """A scene without its payload, in float64; the tensors are differentiable functions of the records."""

    to_local: Float[Tensor, "k 3 3"]
    offset: Float[Tensor, "k 3"]
    """From each box's centre to the camera."""
    pixel_to_world: Float[Tensor, "3 3"]
    """From a pixel [u, v, 1] to its ray's direction, not normalised."""
    stride: Int64[Tensor, "k"]
    """Strides in units of the smallest one, as are all lattice indices here."""
    solid: Bool[Tensor, "k"]
    limits: Int64[ndarray, "r 2"]
    """First and last lattice index of each ray; empty without a span."""
    spacing: float
    index_order: bool
    width: int
    height: int
    given: tuple[Primitives, Camera, Span | None]


def _view(primitives: Primitives, camera: Camera, settings: MarchSettings, span: Span | None) -> _View:
    if not _is_one_scene(primitives, camera, span):
        check_scene(primitives, camera, span)
        check_unbatched(primitives, camera, span)
        raise ValueError(
            f"march_cpu renders boxes with 1 to {LARGEST_PAYLOAD} voxels along each side, on the CPU; these have "
            f"{primitives.density.shape[-1]} and are on {primitives.density.device}: call march_reference"
        )
    half_extent = primitives.half_extent
    solid = (half_extent > 0).all(-1)
    # Boxes without extent are never rendered, so any finite matrix will do.
    inverse = 1 / torch.where(half_extent <= 0, 1, half_extent).double()
    strides = strides_of(primitives, settings)
    unit = int(strides.min()) if len(strides) else 1
    spacing = settings.spacing * unit
    return _View(
        to_local=inverse[:, :, None] * primitives.rotation.double().mT,
        offset=camera.map(lambda tensor: tensor.double()).position - primitives.position.double(),
        pixel_to_world=_pixel_to_world(camera),
        stride=strides // unit,
        solid=solid,
        limits=np.empty((0, 2), np.int64) if span is None else _limits(span, spacing),
        spacing=spacing,
        index_order=settings.compositing == "index_order",
        width=camera.width,
        height=camera.height,
        given=(primitives, camera, span),
    )


def _is_one_scene(primitives: Primitives, camera: Camera, span: Span | None) -> bool:
    """Whether shapes and small fields are valid; boxes are checked when they are packed."""
    k, size = primitives.position.shape[0] if primitives.position.ndim else 0, primitives.density.shape[-1]
    shapes = [
        *((primitives.position, (k, 3)), (primitives.rotation, (k, 3, 3)), (primitives.half_extent, (k, 3))),
        *((primitives.rgb, (k, 3, size, size, size)), (primitives.density, (k, size, size, size))),
        *((camera.intrinsics, (3, 3)), (camera.world_to_camera, (3, 4))),
    ]
    picture = (camera.height, camera.width)
    shapes += [] if span is None else [(span.near, picture), (span.far, picture)]
    if not all(tuple(tensor.shape) == shape and tensor.device.type == "cpu" for tensor, shape in shapes):
        return False
    check_camera(camera)
    whole = span is None or not bool(torch.isnan(span.near).any() or torch.isnan(span.far).any())
    sized = bool(torch.isfinite(primitives.half_extent).all())
    return sized and whole and 1 <= size <= LARGEST_PAYLOAD


def _pixel_to_world(camera: Camera) -> Float[Tensor, "3 3"]:
    """The matrix that `Camera.rays` applies."""
    k = camera.intrinsics.double()
    fx, skew, cx, fy, cy = k[0, 0], k[0, 1], k[0, 2], k[1, 1], k[1, 2]
    none, one = torch.zeros_like(fx), torch.ones_like(fx)
    rows = [1 / fx, -skew / (fx * fy), (skew * cy / fy - cx) / fx, none, 1 / fy, -cy / fy, none, none, one]
    return camera.world_to_camera[:, :3].double().T @ torch.stack(rows).reshape(3, 3)


def _limits(span: Span, spacing: float) -> Int64[ndarray, "r 2"]:
    near, far = (value.detach().double().numpy().ravel() / spacing for value in (span.near, span.far))
    return np.stack([np.ceil(near).clip(1, 2**62), np.floor(far).clip(0, 2**62)], axis=-1).astype(np.int64)


Inputs = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""rgb, density, to_local, offset, pixel_to_world."""


def _scene(view: _View, inputs: Inputs, *, empty_cells: bool) -> PackedScene:
    rgb, density, to_local, offset, pixel_to_world = (tensor.detach() for tensor in inputs)
    if density.shape[-1] == 1:  # one voxel is constant, like two equal ones
        rgb, density = rgb.expand(-1, -1, 2, 2, 2), density.expand(-1, 2, 2, 2)
    scene = pack(
        rgb, density, to_local, offset, view.given[0].rotation.detach(), view.stride, view.solid, pixel_to_world,
        view.width, view.height, empty_cells=empty_cells,
    )  # fmt: skip
    if scene.may_be_degenerate:
        check_scene(*view.given)
    return scene


def _ends(rays: int) -> SaturationPoints:
    """Allocate for a number of rays."""
    return SaturationPoints(
        np.empty(rays, np.int64), np.empty(rays, np.int32), np.empty(rays, np.float32), np.empty((rays, 3), np.float32)
    )


def _draw(
    view: _View, scene: PackedScene, ends: SaturationPoints, counts: Int64[ndarray, "tiles 2"] | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return rgb, alpha, depth and first hit, one row per pixel. Fills `ends` and `counts` unless they are empty."""
    rays = view.width * view.height
    picture = ImageRows(np.empty((rays, 3), np.float32), *(np.empty(rays, np.float32) for _ in range(3)))
    counts = np.empty((0, 2), np.int64) if counts is None else counts
    on_all_threads(
        march_tiles, picture, ends, counts, scene.boxes, scene.size, scene.rectangle, scene.row_start, scene.row_box,
        scene.tile_boxes, heaviest_first(scene.tile_boxes), view.limits, scene.pixel_to_world, view.width, view.height,
        view.spacing, view.index_order,
    )  # fmt: skip
    rgb, alpha, depth, first_hit = map(torch.from_numpy, picture)
    return rgb, alpha, depth, first_hit


class _March(torch.autograd.Function):
    """The image as a function of `Inputs`; torch differentiates `Inputs`."""

    @staticmethod
    def forward(ctx, rgb, density, to_local, offset, pixel_to_world, view):
        """Saves where each ray ends, not its samples."""
        inputs = (rgb, density, to_local, offset, pixel_to_world)
        ctx.view, ctx.ends = view, _ends(view.width * view.height)
        fields = _draw(view, _scene(view, inputs, empty_cells=False), ctx.ends)
        ctx.save_for_backward(*inputs, fields[1], fields[2])
        ctx.mark_non_differentiable(fields[3])
        return fields

    @staticmethod
    def backward(ctx, *cotangents):
        """The box-parallel adjoint; skips gradients that are not required."""
        if torch.is_grad_enabled():
            raise RuntimeError(
                "march_cpu cannot be differentiated twice: omit create_graph=True, or call march_reference"
            )
        *inputs, alpha, depth = ctx.saved_tensors
        upstream = _upstream(ctx.ends, ctx.view.spacing, alpha, depth, *cotangents[:3])
        payload, camera = any(ctx.needs_input_grad[:2]), ctx.needs_input_grad[4]
        geometry = camera or any(ctx.needs_input_grad[2:4])
        scene = _scene(ctx.view, tuple(inputs), empty_cells=ctx.needs_input_grad[1])
        gradients = _adjoin(ctx.view, scene, upstream, payload=payload, geometry=geometry, camera=camera)
        needed = zip(gradients, ctx.needs_input_grad, strict=False)
        return *(gradient if wanted else None for gradient, wanted in needed), None


def _upstream(
    ends: SaturationPoints,
    spacing: float, alpha: Tensor, depth: Tensor, g_rgb: Tensor, g_alpha: Tensor, g_depth: Tensor,
) -> Upstream:  # fmt: skip
    """Gradients of each ray's samples (SPEC 4)."""
    distance, origin, constant = np.empty((3, len(alpha)), np.float32)
    upstream = Upstream(g_rgb.contiguous().numpy(), distance, origin, constant, ends.index, ends.box, ends.share)
    fields = (value.contiguous().numpy() for value in (alpha, depth, g_alpha, g_depth))
    on_all_threads(weigh_rays, upstream, *fields, ends.rgb, spacing)
    return upstream


def _adjoin(
    view: _View, scene: PackedScene, upstream: Upstream, *, payload: bool, geometry: bool, camera: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of `Inputs`, empty if not required."""
    k, size = len(scene.rectangle), scene.size
    held, moved = (k if payload else 0), (k if geometry else 0)
    gradients = Gradients(
        rgb=np.zeros((held, 3, size**3), np.float32),
        density=np.zeros((held, size**3), np.float32),
        to_local=np.zeros((moved, 3, 3)),
        offset=np.zeros((moved, 3)),
        pixel_to_world=np.zeros((k if camera else 0, 3, 3)),
    )
    columns_rows = scene.rectangle.astype(np.int64)
    tiles = (columns_rows[:, 1] - columns_rows[:, 0] + 1) * (columns_rows[:, 3] - columns_rows[:, 2] + 1)
    on_all_threads(
        adjoin_boxes, gradients, upstream, scene.boxes, size, scene.rectangle, heaviest_first(tiles), view.limits,
        scene.pixel_to_world, view.width, view.height, view.spacing, view.index_order,
    )  # fmt: skip
    rgb, density, to_local, offset, parts = map(torch.from_numpy, gradients)
    rgb, density = (value.unflatten(-1, (size, size, size)) for value in (rgb, density))
    if view.given[0].density.shape[-1] == 1:
        rgb, density = (value.sum((-3, -2, -1), keepdim=True) for value in (rgb, density))
    return rgb, density, to_local, offset, parts.sum(0)
