"""Scene of `march_cuda`, and the launch of its kernels: boxes packed and placed, listed by tile, marched (SPEC 4).

The lengths of lists, the number of programs of the backward pass and the lattice points in use depend on the scene, and
are known on the device alone. The host does not wait for them: it launches everything by the `Plan` of the last such
scene, and looks at the totals while the picture is being drawn. If the plan did not fit, the picture is drawn again
before anybody has seen it, so that pictures and gradients depend on the scene alone and not on what was drawn before.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives, S
from primdiffusion.render.cuda import graph as cuda_graph
from primdiffusion.render.cuda import triton_boxes, triton_lists, triton_march
from primdiffusion.render.lattice import MarchSettings, Span, check_scene

LIST_LIMIT = 1 << 24
"""Limit for entries of tile lists, 16 bytes each; images that need more use the lists of bins, shorter but coarser."""
LAST_POINT = (1 << 30) - 1
"""Lattice indices have 32 bits."""
MOST_RANKED = 1 << 13
"""Boxes that are sorted by comparing all pairs, in one launch."""
ROOM = 1.25
"""Length of lists over what the scene needs, for the scenes after it."""
MULTIPLE = 1024
"""Lengths are multiples of it: Triton compiles anew for some that are not multiples of 16."""
MOST_PLANS = 64
LANES = 32
"""Boxes per program of `place_boxes` and `order_boxes`."""
LANES_OF_ORDER = 256
LANES_OF_BIN = 512
LANES_OF_TILE = 64
"""Boxes that a box is compared with, and that a bin, and a tile, tests at once."""
BOX_FIELDS = ("position", "rotation", "half_extent", "rgb", "density")
Picture = tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w"], Float[Tensor, "b h w"], Float[Tensor, "b h w"]]
"""rgb, alpha, depth, first hit."""
Drawing = TypeVar("Drawing")


@dataclasses.dataclass(frozen=True)
class Shapes:
    """Division of work into Triton programs; does not change the result."""

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


class MarchScene(NamedTuple):
    """Arguments of the marcher that are not differentiable."""

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

    @property
    def kind(self) -> tuple:
        """Properties that scenes with a common plan share."""
        position, size = self.primitives.position, (self.camera.width, self.camera.height)
        return (*position.shape[:2], len(self.camera.intrinsics), *size, self.settings, self.shapes, position.device)

    def check(self, totals: list[int]) -> None:
        """Raise the ValueError of `check_scene` if the kernels found errors."""
        if totals[0] or totals[4]:
            check_scene(self.primitives, self.camera, self.span)


class Plan(NamedTuple):
    """Launch parameters of the kernels that depend on the scene."""

    bins: int
    """Entries of the lists of bins."""
    tiles: int
    """Entries of the lists of tiles; 0 if those of bins are used."""
    units: int
    """Programs of a backward pass that is recorded."""
    gap: int
    """The largest of 1, 2, 4 that divides the strides of all visible boxes."""

    @classmethod
    def of(cls, totals: list[int]) -> Plan:
        """The plan for a scene with these totals (see `triton_boxes`)."""
        _, bins, tiles, units, _, strides = totals
        gap = 1 if strides & 1 else 2 if strides & 2 else 4
        return cls(_with_room(bins), 0 if tiles > LIST_LIMIT else _with_room(tiles), _with_room(units), gap)

    def fits(self, totals: list[int]) -> bool:
        """Whether a scene with these totals is drawn by this plan as by its own."""
        own = Plan.of(totals)
        same = (self.gap, self.tiles == 0) == (own.gap, own.tiles == 0)
        enough = totals[1] <= self.bins and (not self.tiles or totals[2] <= self.tiles) and totals[3] <= self.units
        return same and enough and not (totals[0] or totals[4])


_plans: dict[tuple, Plan] = {}
"""The plan of the last scene of each kind."""


def _with_room(entries: int) -> int:
    return max(-(-int(entries * ROOM) // MULTIPLE), 1) * MULTIPLE


class Packed(NamedTuple):
    """Contents of boxes (see `triton_boxes`)."""

    voxels: Float[Tensor, "p k 512 4"]
    bounds: Int[Tensor, "p k 8"]

    @classmethod
    def room(cls, people: int, boxes: int, device: torch.device) -> Packed:
        """Uninitialised memory."""
        bounds = torch.empty((people, boxes, 8), dtype=torch.int32, device=device)
        return cls(torch.empty((people, boxes, 512, 4), device=device), bounds)

    def pack(self, rgb: Tensor, density: Tensor) -> Packed:
        """Fill with these contents, and return self."""
        launch(triton_boxes.pack_boxes, (self.bounds[..., 0].numel(),), rgb, density, *self, num_warps=4)
        return self


class PlacedBoxes(NamedTuple):
    """Boxes as the views see them (see `triton_boxes`)."""

    record: Float[Tensor, "b k 32"]
    indices: Int[Tensor, "b k 16"]
    order: Int[Tensor, "b k"]
    """Nearest box first."""
    reach: Int[Tensor, "b h w 2"] | None
    totals: Int[Tensor, "6"]


class _Lists(NamedTuple):
    """The boxes of each tile, or of each bin."""

    entries: Int[Tensor, "n 4"]
    begin: Int[Tensor, "b lists"]
    count: Int[Tensor, "b lists"]
    tiles_of_list: int


class Kept(NamedTuple):
    """Values that the backward pass needs of each ray (see `march_tiles`)."""

    values: Float[Tensor, "b h w 8"]
    ends: Int[Tensor, "b h w 2"]


def launch(kernel: Any, grid: tuple[int, ...], *arguments: Any, **options: Any) -> None:
    """Launch a Triton kernel, with one stage: prefetching through shared memory costs more registers than it gains."""
    kernel[grid](*arguments, **options, num_stages=1)


def on_device(device: torch.device) -> contextlib.AbstractContextManager[Any]:
    """Launch on this device; Triton's interpreter works on processors."""
    return torch.cuda.device(device) if device.type == "cuda" else contextlib.nullcontext()


def check(primitives: Primitives, camera: Camera, span: Span | None) -> None:
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


@functools.cache
def _lattice(spacing: float, thresholds: tuple[float, ...], device: torch.device) -> Tensor:
    """The argument `lattice` of `place_boxes`: copying it synchronises. Kept for good, because graphs read it."""
    return torch.tensor([spacing, *thresholds], dtype=torch.float64, device=device)


def place(
    scene: MarchScene, packed: Packed, geometry: list[Tensor], intrinsics: Tensor, world_to_camera: Tensor
) -> PlacedBoxes:
    """Place the boxes, whose position, rotation and half extent are `geometry`, as each view sees them."""
    shapes, width, height = scene.shapes, scene.camera.width, scene.camera.height
    (p, k), b, device = geometry[0].shape[:2], len(intrinsics), intrinsics.device
    totals = torch.zeros(triton_boxes.TOTALS, dtype=torch.int64, device=device)
    record = torch.empty((b, k, triton_boxes.RECORD), device=device)
    indices = torch.empty((b, k, triton_boxes.INDICES), dtype=torch.int32, device=device)
    first_point, order = torch.empty((2, b, k), dtype=torch.int32, device=device)
    fineness = scene.spacing * scene.settings.samples_per_voxel
    lattice = _lattice(scene.spacing, tuple(stride * fineness for stride in scene.strides), device)
    launch(triton_boxes.place_boxes, (-(-k // LANES), b), 
        *geometry, packed.bounds, intrinsics, world_to_camera, lattice, record, indices, first_point,
        totals, k, k if p == b else 0, width, height, shapes.blocks_for(b * height * width),
        STRIDES=scene.strides, TILE_WIDTH=shapes.tile[0], TILE_HEIGHT=shapes.tile[1], BIN=shapes.bin,
        BLOCK_WIDTH=shapes.block[0], BLOCK_HEIGHT=shapes.block[1], LANES=LANES, num_warps=1,
    )  # fmt: skip
    if k <= MOST_RANKED:
        grid, lanes = (-(-k // LANES), b), {"LANES": LANES, "CHUNK": LANES_OF_ORDER}
        launch(triton_lists.order_boxes, grid, first_point, order, k, **lanes, num_warps=4)
    else:
        order = torch.argsort(first_point, dim=-1, stable=True).int()
    reach = None
    if scene.span is not None:
        limits = (scene.span.near.detach(), scene.span.far.detach())
        totals[4] += sum(torch.isnan(limit).sum() for limit in limits)
        first, last = (limit.double() / scene.spacing for limit in limits)
        reach = torch.stack([first.ceil().clamp(1, LAST_POINT), last.floor().clamp(0, LAST_POINT)], dim=-1).int()
    return PlacedBoxes(record, indices, order, reach, totals)


def drawn(scene: MarchScene, placed: PlacedBoxes, draw: Callable[[Plan], Drawing]) -> tuple[Drawing, int]:
    """Draw by the plan of the last such scene, again if it does not fit; also the programs of the backward pass.

    The host waits for the totals while the picture is being drawn. In a recording it cannot: then each repetition
    looks at them, and this is drawn again from Python if they do not fit.
    """
    plan, kind = _plans.get(scene.kind), scene.kind
    if plan is not None and cuda_graph.recording():
        cuda_graph.expect(placed.totals, plan.fits)
        return draw(plan), plan.units
    reading = cuda_graph.Reading(placed.totals)
    drawing = None if plan is None else draw(plan)
    totals = reading.wait()
    scene.check(totals)
    if plan is None or drawing is None or not plan.fits(totals):
        _plans.pop(kind, None)
        if len(_plans) >= MOST_PLANS:
            _plans.pop(next(iter(_plans)))
        plan = _plans[kind] = Plan.of(totals)
        drawing = draw(plan)
    return drawing, totals[3]


def new_picture(b: int, height: int, width: int, device: torch.device) -> Picture:
    """Uninitialised memory for a picture."""
    flat, new = (b, height, width), functools.partial(torch.empty, device=device)
    return new((*flat, 3)), new(flat), new(flat), new(flat)


def march_constants(shapes: Shapes, sets: int, gap: int) -> dict[str, int]:
    """Compile-time constants of `march_tiles`: `sets` of lattice points, `gap` apart."""
    coarse = shapes.samples // (2 if sets == 4 else 1)
    return {"TILE_WIDTH": shapes.tile[0], "TILE_HEIGHT": shapes.tile[1], "COARSE": coarse, "SETS": sets, "GAP": gap}


def draw(scene: MarchScene, packed: Packed, placed: PlacedBoxes, picture: Picture, plan: Plan) -> Kept:
    """List the boxes by tile and march; writes `picture`."""
    shapes, (b, height, width), device = scene.shapes, picture[1].shape, picture[1].device
    (p, k), keep = packed.bounds.shape[:2], scene.keep or scene.index_order
    kept = torch.empty((b, height, width, 8) if keep else 0, device=device)
    ends = torch.empty((b, height, width, 2) if keep else 0, dtype=torch.int32, device=device)
    fine = math.gcd(max(scene.strides), 4)
    gap = min(plan.gap, fine)
    across, down = -(-width // shapes.tile[0]), -(-height // shapes.tile[1])
    boxes = (placed.record, placed.indices, packed.voxels)
    *lists, tiles_of_list = _list(scene, plan, placed, placed.order)
    list_across = -(-across // tiles_of_list)
    sizes = (k, k if p == b else 0, height, width, across, list_across, lists[1].shape[1], scene.spacing)
    launch(triton_march.march_tiles, (across * down, b), 
        *boxes, *lists, placed.reach, *picture, kept, ends, *sizes,
        TILES_OF_LIST=tiles_of_list, HAS_SPAN=placed.reach is not None, KEEP=keep,
        WHOLE=all(fine % stride == 0 for stride in scene.strides), INDEX_ORDER=scene.index_order,
        **march_constants(shapes, fine // gap, gap), num_warps=shapes.march_warps, maxnreg=shapes.march_registers,
    )  # fmt: skip
    if scene.index_order:
        by_index = torch.arange(k, dtype=torch.int32, device=device).repeat(b, 1)
        launch(triton_march.end_in_order, (across * down, b), 
            *boxes, *_list(scene, plan, placed, by_index)[:3], picture[0], kept, ends, *sizes,
            TILES_OF_LIST=tiles_of_list, TILE_WIDTH=shapes.tile[0], TILE_HEIGHT=shapes.tile[1], num_warps=1,
        )  # fmt: skip
    return Kept(kept, ends)


def _list(scene: MarchScene, plan: Plan, placed: PlacedBoxes, order: Int[Tensor, "b k"]) -> _Lists:
    """List the boxes of each tile, or bin, in `order`; a list may be cut short where the plan does not fit."""
    (b, k), device = order.shape, order.device
    shapes, width, height = scene.shapes, scene.camera.width, scene.camera.height
    across, down = -(-width // shapes.tile[0]), -(-height // shapes.tile[1])
    bins_across, bins_down = -(-across // shapes.bin), -(-down // shapes.bin)
    bins, tiles = bins_across * bins_down, across * down
    written = torch.zeros(2, dtype=torch.int64, device=device)

    def a_list(entries: int, lists: int) -> tuple[Tensor, Tensor, Tensor]:
        empty = torch.empty((entries, triton_lists.ENTRY), dtype=torch.int32, device=device)
        begin = torch.empty((b, lists), dtype=torch.int64, device=device)
        return empty, begin, torch.empty((b, lists), dtype=torch.int32, device=device)

    bin_lists = a_list(plan.bins, bins)
    launch(triton_lists.list_bins, (bins, b), 
        order, placed.indices, *bin_lists, written, plan.bins, k, bins_across,
        BIN=shapes.bin, LANES=LANES_OF_BIN, num_warps=4,
    )  # fmt: skip
    if not plan.tiles:
        return _Lists(*bin_lists, shapes.bin)
    tile_lists = a_list(plan.tiles, tiles)
    launch(triton_lists.list_tiles, (tiles, b), 
        *bin_lists, placed.record, placed.indices, *tile_lists, written, plan.tiles, k, across, bins_across, bins,
        scene.spacing,
        BIN=shapes.bin, TILE_WIDTH=shapes.tile[0], TILE_HEIGHT=shapes.tile[1], LANES=LANES_OF_TILE, num_warps=1,
    )  # fmt: skip
    return _Lists(*tile_lists, 1)
