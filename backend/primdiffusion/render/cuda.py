"""The fast marcher for CUDA devices: Triton kernels, float32, batched, with a hand-written adjoint (SPEC 4).

The same rule as `reference.py`. Triton compiles the kernels on first use and caches them on disk; it is imported only
then, so that this module loads without it. An image takes the launches of `_prepare` and one of `march_tiles`; in
index order one more, of `end_in_order`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.util
import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives, S
from primdiffusion.render.compositing import Rendering
from primdiffusion.render.lattice import MarchSettings, Span, check_scene

LIST_LIMIT = 1 << 24
"""Limit for entries of tile lists, 16 bytes each; images that need more use the lists of bins, shorter but coarser."""
LAST_POINT = (1 << 30) - 1
"""Lattice indices have 32 bits."""
LANES = 32
"""Boxes per program of `place_boxes`."""
LANES_OF_SEEDS = 256
"""Rays per program of `seed_rays`."""
LANES_OF_BIN = 512
LANES_OF_TILE = 64
"""Boxes that a bin, and a tile, tests at once."""


@dataclasses.dataclass(frozen=True)
class Shapes:
    """How work is divided into Triton programs; does not change the result."""

    tile: tuple[int, int] = (8, 4)
    """Pixels per program of the forward pass, across and down."""
    bin: int = 8
    """Tiles along a side of a bin."""
    samples: int = 8
    """Samples of a chunk per pixel and box; half as many if boxes of three strides overlap."""
    march_warps: int = 4
    march_registers: int = 160
    """Registers per thread; fewer increase occupancy, but spill."""
    block: tuple[int, int] = (8, 4)
    """Pixels per step of the backward pass."""
    blocks_of_unit: int = 16
    """Steps per program of the backward pass in images of up to 512 x 512; more in larger ones."""
    adjoint_warps: int = 1

    def blocks_for(self, pixels: int) -> int:
        """Blocks per program of the backward pass: enough programs at any size, in constant memory."""
        return self.blocks_of_unit * max(pixels, 512 * 512) // (512 * 512)


def available(device: torch.device | str = "cuda") -> bool:
    """Whether `march_cuda` can run on `device`, which requires CUDA and Triton."""
    return torch.device(device).type == "cuda" and importlib.util.find_spec("triton") is not None


def suits(primitives: Primitives, camera: Camera) -> bool:
    """Whether `march_cuda` supports the scene: float32, voxels of 8^3."""
    tensors = [*vars(primitives).values(), camera.intrinsics, camera.world_to_camera]
    single = all(tensor.dtype == torch.float32 for tensor in tensors)
    return single and primitives.density.shape[-3:] == (S, S, S)


def march_cuda(
    primitives: Primitives,
    camera: Camera,
    settings: MarchSettings = MarchSettings(),  # noqa: B008
    span: Span | None = None,
    shapes: Shapes = Shapes(),
) -> Rendering:
    """As `march_reference`, in float32 on a CUDA device; images [B, H, W].

    `primitives` have one leading dimension, 1 or B (1: all views see the same boxes), `camera` and `span` B.
    Differentiable once in every tensor of primitives and camera. Images and gradients are deterministic. Voxel
    gradients are summed in tf32 (eleven significant bits per term). Synchronises with the device once per call, for
    checks and the lengths of lists. Memory beyond inputs and outputs: 9 KB per box, and 16 bytes for each tile that a
    box touches, at most `LIST_LIMIT` of them; with gradients 40 bytes per pixel, and during the backward pass another
    32 per pixel and 8 KB for every 512 pixels of a box (for more pixels in larger images). In index order 40 bytes per
    pixel even without gradients, and lists twice.

    Raises ValueError as `check_scene` does, for voxels other than 8^3 and dtypes other than float32; ImportError
    without Triton.
    """
    _check(primitives, camera, span)
    if importlib.util.find_spec("triton") is None:
        raise ImportError(
            "march_cuda needs Triton, which is not installed: install the version of triton that your torch requires "
            "(`pip show torch`), or call march_reference"
        )
    tensors = [getattr(primitives, name) for name in BOX_FIELDS] + [camera.intrinsics, camera.world_to_camera]
    keep = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    scene = _Scene(primitives, camera, settings, span, shapes, keep)
    device = primitives.position.device
    with torch.cuda.device(device) if device.type == "cuda" else contextlib.nullcontext():
        return Rendering(*_March.apply(scene, *tensors))


BOX_FIELDS = ("position", "rotation", "half_extent", "rgb", "density")


class _Scene(NamedTuple):
    """Arguments of `_March` that are not differentiable."""

    primitives: Primitives
    camera: Camera
    settings: MarchSettings
    span: Span | None
    shapes: Shapes
    keep: bool
    """Whether there will be a backward pass."""

    @property
    def index_order(self) -> bool:
        """Whether boxes are composited in the order of their index."""
        return self.settings.compositing == "index_order"

    @property
    def unit(self) -> int:
        """Common divisor of all strides, in lattice points: the unit of the kernels."""
        return math.gcd(*self.settings.strides)

    @property
    def spacing(self) -> float:
        """Length of a unit, metres."""
        return self.settings.spacing * self.unit

    @property
    def strides(self) -> tuple[int, ...]:
        """The settings' strides in units."""
        return tuple(stride // self.unit for stride in self.settings.strides)


class _Lists(NamedTuple):
    """The boxes of each tile, or of each bin."""

    entries: Int[Tensor, "n 4"]
    begin: Int[Tensor, "b lists"]
    count: Int[Tensor, "b lists"]
    tiles_of_list: int


class _Prepared(NamedTuple):
    """Packed boxes (see `triton_boxes`), and their lists."""

    voxels: Float[Tensor, "p k 512 4"]
    record: Float[Tensor, "b k 32"]
    indices: Int[Tensor, "b k 16"]
    reach: Int[Tensor, "b h w 2"] | None
    lists: _Lists
    """Nearest box first."""
    in_order: _Lists | None
    """Lowest index first; only in index order."""
    gap: int
    """The largest of 1, 2, 4 that divides the strides of all visible boxes."""
    units: int
    """Number of programs of the backward pass."""


def _launch(kernel: Any, grid: tuple[int, ...], *arguments: Any, **options: Any) -> None:
    """Launch a Triton kernel, with one stage: prefetching through shared memory costs more registers than it gains."""
    kernel[grid](*arguments, **options, num_stages=1)


def _check(primitives: Primitives, camera: Camera, span: Span | None) -> None:
    """Check everything that needs no synchronisation with the device."""
    tensors = [*vars(primitives).values(), camera.intrinsics, camera.world_to_camera]
    if any(tensor.dtype != torch.float32 for tensor in tensors):
        dtypes = sorted({str(tensor.dtype) for tensor in tensors})
        raise ValueError(f"march_cuda takes float32, not {dtypes}: convert with .to(), or call march_reference")
    b, k = camera.intrinsics.shape[0] if camera.intrinsics.ndim == 3 else -1, primitives.position.shape[-2]
    p = primitives.position.shape[0] if primitives.position.ndim == 3 else -1
    shapes = [(p, k, 3), (p, k, 3, 3), (p, k, 3), (p, k, 3, S, S, S), (p, k, S, S, S), (b, 3, 3), (b, 3, 4)]
    actual = [tuple(getattr(primitives, name).shape) for name in BOX_FIELDS]
    actual += [tuple(camera.intrinsics.shape), tuple(camera.world_to_camera.shape)]
    fits = span is None or {tuple(span.near.shape), tuple(span.far.shape)} == {(b, camera.height, camera.width)}
    pixels = camera.width > 0 and camera.height > 0
    if actual != shapes or p not in (1, b) or b < 1 or not pixels or not fits:
        check_scene(primitives, camera, span)
        raise ValueError(
            f"march_cuda takes primitives [1 or B, K, ...] of {S}^3 voxels, a camera [B, ...] and a span [B, H, W]; "
            f"these are {dict(zip((*BOX_FIELDS, 'intrinsics', 'world_to_camera'), actual, strict=True))}: call march"
        )
    if len({tensor.device for tensor in tensors}) > 1:
        check_scene(primitives, camera, span)


@functools.lru_cache(maxsize=32)
def _lattice(spacing: float, thresholds: tuple[float, ...], device: torch.device) -> Tensor:
    """The argument `lattice` of `place_boxes`, cached because copying it to the device synchronises."""
    return torch.tensor([spacing, *thresholds], dtype=torch.float64, device=device)


def _prepare(scene: _Scene, boxes: list[Tensor], intrinsics: Tensor, world_to_camera: Tensor) -> _Prepared:
    """Pack, place and check the boxes, and list them by tile."""
    # triton is optional
    from primdiffusion.render import triton_boxes

    position, rotation, half_extent, rgb, density = boxes
    shapes, width, height = scene.shapes, scene.camera.width, scene.camera.height
    (p, k), b, device = position.shape[:2], len(intrinsics), position.device
    own_boxes = k if p == b else 0
    totals = torch.zeros(triton_boxes.TOTALS, dtype=torch.int64, device=device)
    voxels = torch.empty((p, k, 512, 4), device=device)
    bounds = torch.empty((p, k, 8), dtype=torch.int32, device=device)
    _launch(triton_boxes.pack_boxes, (p * k,), rgb, density, voxels, bounds, totals, num_warps=4)

    record = torch.empty((b, k, triton_boxes.RECORD), device=device)
    indices = torch.empty((b, k, triton_boxes.INDICES), dtype=torch.int32, device=device)
    first_point = torch.empty((b, k), dtype=torch.int32, device=device)
    fineness = scene.spacing * scene.settings.samples_per_voxel
    lattice = _lattice(scene.spacing, tuple(stride * fineness for stride in scene.strides), device)
    _launch(triton_boxes.place_boxes, (-(-k // LANES), b), 
        position, rotation, half_extent, bounds, intrinsics, world_to_camera, lattice, record, indices, first_point,
        totals, k, own_boxes, width, height, shapes.blocks_for(b * height * width),
        STRIDES=scene.strides, TILE_WIDTH=shapes.tile[0], TILE_HEIGHT=shapes.tile[1], BIN=shapes.bin,
        BLOCK_WIDTH=shapes.block[0], BLOCK_HEIGHT=shapes.block[1], LANES=LANES, num_warps=1,
    )  # fmt: skip
    order = torch.argsort(first_point, dim=-1, stable=True)
    reach = None
    if scene.span is not None:
        limits = (scene.span.near.detach(), scene.span.far.detach())
        totals[6] += sum(torch.isnan(limit).sum() for limit in limits)
        first, last = (limit.double() / scene.spacing for limit in limits)
        reach = torch.stack([first.ceil().clamp(1, LAST_POINT), last.floor().clamp(0, LAST_POINT)], dim=-1).int()

    wrong, in_bins, in_tiles, units, _, _, no_number, finest = totals.tolist()
    if wrong or no_number:
        check_scene(scene.primitives, scene.camera, scene.span)
    gap = 1 if finest & 1 else 2 if finest & 2 else 4
    lists = _list(scene, order, record, indices, totals, in_bins, in_tiles)
    in_order = None
    if scene.index_order:
        by_index = torch.arange(k, device=device).repeat(b, 1)
        in_order = _list(scene, by_index, record, indices, torch.zeros_like(totals), in_bins, in_tiles)
    return _Prepared(voxels, record, indices, reach, lists, in_order, gap, units)


def _list(
    scene: _Scene, order: Tensor, record: Tensor, indices: Tensor, totals: Tensor, in_bins: int, in_tiles: int
) -> _Lists:
    """List the boxes of each tile in `order` [b, k]; `totals` counts the entries written."""
    # triton is optional
    from primdiffusion.render import triton_lists

    (b, k), device = order.shape, order.device
    shapes, width, height = scene.shapes, scene.camera.width, scene.camera.height
    across, down = -(-width // shapes.tile[0]), -(-height // shapes.tile[1])
    bins_across, bins_down = -(-across // shapes.bin), -(-down // shapes.bin)
    bins, tiles = bins_across * bins_down, across * down

    def a_list(entries: int, lists: int) -> tuple[Tensor, Tensor, Tensor]:
        empty = torch.empty((entries, triton_lists.ENTRY), dtype=torch.int32, device=device)
        begin = torch.empty((b, lists), dtype=torch.int64, device=device)
        return empty, begin, torch.empty((b, lists), dtype=torch.int32, device=device)

    bin_lists = a_list(in_bins, bins)
    _launch(
        triton_lists.list_bins,
        (bins, b),
        order,
        indices,
        *bin_lists,
        totals,
        k,
        bins_across,
        BIN=shapes.bin,
        LANES=LANES_OF_BIN,
        num_warps=4,
    )
    if in_tiles > LIST_LIMIT:
        return _Lists(*bin_lists, shapes.bin)
    tile_lists = a_list(in_tiles, tiles)
    _launch(triton_lists.list_tiles, (tiles, b), 
        *bin_lists, record, indices, *tile_lists, totals, k, across, bins_across, bins, scene.spacing,
        BIN=shapes.bin, TILE_WIDTH=shapes.tile[0], TILE_HEIGHT=shapes.tile[1], LANES=LANES_OF_TILE, num_warps=1,
    )  # fmt: skip
    return _Lists(*tile_lists, 1)


def march_constants(shapes: Shapes, sets: int, gap: int) -> dict[str, int]:
    """Compile-time constants of `march_tiles`: `sets` of lattice points, `gap` apart."""
    coarse = shapes.samples // (2 if sets == 4 else 1)
    return {"TILE_WIDTH": shapes.tile[0], "TILE_HEIGHT": shapes.tile[1], "COARSE": coarse, "SETS": sets, "GAP": gap}


class _March(torch.autograd.Function):
    """Forward pass and adjoint (SPEC 4). The gradient of a sample depends on it and a few numbers of its ray."""

    @staticmethod
    def forward(ctx: Any, scene: _Scene, *tensors: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        # triton is optional
        from primdiffusion.render import triton_march

        *boxes, intrinsics, world_to_camera = [tensor.detach().contiguous() for tensor in tensors]
        (p, k), b = boxes[0].shape[:2], len(intrinsics)
        shapes, (width, height) = scene.shapes, (scene.camera.width, scene.camera.height)
        if k == 0:
            check_scene(scene.primitives, scene.camera, scene.span)
            nothing = intrinsics.new_zeros((b, height, width))
            infinity = torch.full_like(nothing, torch.inf)
            ctx.units, ctx.nothing = None, [tensor.shape for tensor in tensors]
            picture = (nothing[..., None].expand(b, height, width, 3).clone(), nothing, infinity, infinity.clone())
            ctx.mark_non_differentiable(picture[3])
            return picture
        ready = _prepare(scene, boxes, intrinsics, world_to_camera)
        new = functools.partial(torch.empty, device=intrinsics.device)
        flat = (b, height, width)
        picture = (new((*flat, 3)), new(flat), new(flat), new(flat))
        keep = scene.keep or scene.index_order
        kept = new((*flat, 8) if keep else 0)
        ends = new((*flat, 2) if keep else 0, dtype=torch.int32)
        fine = math.gcd(max(scene.strides), 4)
        gap = min(ready.gap, fine)
        across, down = -(-width // shapes.tile[0]), -(-height // shapes.tile[1])
        packed, (*lists, tiles_of_list) = (ready.record, ready.indices, ready.voxels), ready.lists
        list_across = -(-across // tiles_of_list)
        sizes = (k, k if p == b else 0, height, width, across, list_across, lists[1].shape[1], scene.spacing)
        _launch(triton_march.march_tiles, (across * down, b), 
            *packed, *lists, ready.reach, *picture, kept, ends, *sizes,
            TILES_OF_LIST=tiles_of_list, HAS_SPAN=ready.reach is not None, KEEP=keep,
            WHOLE=all(fine % stride == 0 for stride in scene.strides), INDEX_ORDER=scene.index_order,
            **march_constants(shapes, fine // gap, gap), num_warps=shapes.march_warps, maxnreg=shapes.march_registers,
        )  # fmt: skip
        if ready.in_order is not None:
            _launch(triton_march.end_in_order, (across * down, b), 
                *packed, *ready.in_order[:3], picture[0], kept, ends, *sizes,
                TILES_OF_LIST=tiles_of_list, TILE_WIDTH=shapes.tile[0], TILE_HEIGHT=shapes.tile[1], num_warps=1,
            )  # fmt: skip
        ctx.mark_non_differentiable(picture[3])
        ctx.shapes, ctx.spacing, ctx.units, ctx.index_order = shapes, scene.spacing, ready.units, scene.index_order
        geometry = (*boxes[:3], intrinsics, world_to_camera)
        if scene.keep:
            ctx.save_for_backward(*geometry, *packed, ready.reach, kept, ends)
        return picture

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *on_picture: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        if ctx.units is None:
            return None, *(on_picture[0].new_zeros(shape) for shape in ctx.nothing)
        settings = (ctx.shapes, ctx.spacing, ctx.units, ctx.index_order)
        return None, *_adjoint(*settings, *on_picture[:3], *ctx.saved_tensors)


def _adjoint(
    shapes: Shapes,
    spacing: float,
    units: int,
    index_order: bool,
    on_rgb: Tensor,
    on_alpha: Tensor,
    on_depth: Tensor,
    *saved: Tensor,
) -> tuple[Tensor, ...]:
    """Gradients in the order of `_March.forward`'s tensors."""
    # triton is optional
    from primdiffusion.render import triton_adjoint

    position, rotation, half_extent, intrinsics, world_to_camera, record, indices, voxels, reach, kept, ends = saved
    height, width = on_alpha.shape[1:]
    (p, k), b, device = position.shape[:2], len(intrinsics), position.device
    own_boxes = k if p == b else 0
    new = functools.partial(torch.empty, device=device)

    seeds = new((b, height, width, 8))
    rays = b * height * width
    _launch(triton_adjoint.seed_rays, (-(-rays // LANES_OF_SEEDS),), 
        on_rgb.contiguous(), on_alpha.contiguous(), on_depth.contiguous(), kept, ends, seeds, rays, spacing,
        INDEX_ORDER=index_order, LANES=LANES_OF_SEEDS, num_warps=4,
    )  # fmt: skip
    blocks = indices[..., 12].flatten().long()
    blocks_of_unit = shapes.blocks_for(b * height * width)
    units_of_box = (blocks + blocks_of_unit - 1) // blocks_of_unit
    unit_end = units_of_box.cumsum(0)
    unit_box = torch.repeat_interleave(units_of_box, output_size=units)
    unit_part = torch.arange(units, device=device) - (unit_end - units_of_box)[unit_box]
    unit_voxels, unit_sums = new((units, 64, 32)), new((units, triton_adjoint.SUMS))
    if units:
        _launch(triton_adjoint.adjoint_boxes, (units,), 
            record, indices, voxels, reach, seeds, ends, unit_box, unit_part, rotation, half_extent, intrinsics,
            world_to_camera, unit_voxels, unit_sums, k, own_boxes, height, width, blocks_of_unit,
            spacing, HAS_SPAN=reach is not None, INDEX_ORDER=index_order, BLOCK_WIDTH=shapes.block[0],
            BLOCK_HEIGHT=shapes.block[1], num_warps=shapes.adjoint_warps,
        )  # fmt: skip
    on_boxes = [new(shape) for shape in ((p, k, 3), (p, k, 3, 3), (p, k, 3), (p, k, 3, S, S, S), (p, k, S, S, S))]
    on_camera = new((b, k, 12))
    _launch(
        triton_adjoint.finish_boxes,
        (k, p),
        unit_end,
        unit_voxels,
        unit_sums,
        rotation,
        half_extent,
        *on_boxes,
        on_camera,
        b // p,
        k,
        own_boxes,
        num_warps=4,
    )
    return *on_boxes, *_camera_gradient(on_camera.sum(1).double(), intrinsics.double(), world_to_camera.double())


def _camera_gradient(
    sums: Float[Tensor, "b 12"], intrinsics: Float[Tensor, "b 3 3"], world_to_camera: Float[Tensor, "b 3 4"]
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3 4"]]:
    """From dL/do and sum dc v^T (see `triton_adjoint`), with o = -R_c^T t, m = R_c^T dc, dc = K^-1 [u, v, 1]."""
    on_origin, on_rotation = sums[:, :3], sums[:, 3:].unflatten(1, (3, 3))
    rotation, translation = world_to_camera[..., :3], world_to_camera[..., 3]
    # sum dL/dx [x, y, 1] and the same of y, for dc = [x, y, 1].
    on_dc = torch.einsum("bij,bkj->bik", rotation[:, :2], on_rotation)
    fx, skew, fy = intrinsics[:, 0, 0], intrinsics[:, 0, 1], intrinsics[:, 1, 1]
    on_x = -on_dc[:, 0] / fx[:, None]
    on_y = -(on_dc[:, 1] + skew[:, None] * on_x) / fy[:, None]
    zero = torch.zeros_like(fx)
    on_lens = [on_x[:, 0], on_x[:, 1], on_x[:, 2], zero, on_y[:, 1], on_y[:, 2], zero, zero, zero]
    on_rotation = on_rotation - translation[:, :, None] * on_origin[:, None, :]
    on_translation = -(rotation @ on_origin[..., None])
    gradients = torch.stack(on_lens, -1).unflatten(-1, (3, 3)), torch.cat([on_rotation, on_translation], -1)
    return gradients[0].float(), gradients[1].float()
