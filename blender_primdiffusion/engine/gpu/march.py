"""The ray marcher on the GPU that shows Blender's windows: compute shaders, no child process, no torch.

It follows the rule of docs/design/marcher.md and agrees with the backend's marchers. A sample in a box is
y = W (o + t d - T), W = diag(1 / half_extent) R^T. Shaders have only float32, in which t d and T - o cancel far from
the camera, so each box has a reference point near itself, computed here in float64: the lattice point n0 on the ray
through its centre, whose direction is D and whose pixel is (u0, v0). The ray of pixel (u, v), m = R_c^T K^-1 [u, v, 1],
is m0 + du a + dv b; its direction is D + delta, delta = (du a + dv b - D (|m| - |m0|)) / |m|, and

    y = e + t0 W delta + (n - n0) spacing W (D + delta),        e = W (o + t0 D - T).

The nine texels of a box's record: (n0, first, last, stride), (W a, |m0|), (W b, 2 m0.a), (W D, 2 m0.b), (e, t0), (lower
bounds of its content, length of a sample times the scale of its density), (upper bounds, place in the atlas), (u0 and
v0, each as whole and 1/2 - fraction), (first column, row, last column, row of pixels). Lattice points count from a
common one near the boxes. Records and lists are textures: Python gets storage buffers with Blender 5.3.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import gpu
import numpy as np
from numpy.typing import NDArray

from ..boxes import Boxes
from ..view import PinholeView
from . import shaders
from .shaders import ACROSS, BOXES_A_ROW, ENTRIES_A_ROW, TEXELS, TILE, VOXELS, WIDER, cache_until_exit

STRIDES = [1, 2, 4]
SAMPLES_PER_VOXEL = 2.0
"""As the backend's `MarchSettings`."""
MOST_DOUBLINGS = 16
"""Largest number of doublings of a stride, for large humans beside small ones; as in the backend."""
MOST_ENTRIES = 2**22
"""Largest number of entries in all tiles' lists; with more, boxes are listed for larger tiles."""
_SHADERS = {
    "list": shaders.list_shader,
    "march": shaders.march_shader,
    "copy": shaders.copy_shader,
    "rebind": shaders.rebind_shader,
}
_OPTICAL = 1e-2
_FAR_PIXEL = 1e6
_LARGEST_HALF = 65504.0
_CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
_EDGES = np.array([[i, i | 1 << axis] for axis in range(3) for i in range(8) if not i >> axis & 1])


class GpuPayload:
    """Colour and density of a human's boxes on the GPU, 4 MB for 1024 boxes; freed with the object."""

    def __init__(self, rgb: NDArray, density: NDArray):
        """`rgb` [K, 3, 8, 8, 8] is linear, `density` [K, 8, 8, 8] in 1/m; voxel axes N, B, T as in the backend."""
        self.count = len(density)
        self.rows = max(-(-self.count // ACROSS), 1)
        values = np.zeros((self.rows * ACROSS, 4, VOXELS, VOXELS, VOXELS), np.float32)
        values[: self.count, :3] = rgb
        values[: self.count, 3] = np.minimum(density, _LARGEST_HALF)
        parts = values.reshape(self.rows, ACROSS, 4, VOXELS, VOXELS, VOXELS)
        bricks = parts.transpose(3, 0, 4, 1, 5, 2).reshape(VOXELS, self.rows * VOXELS, -1, 4)
        self.texture = _texture(bricks, "RGBA16F")
        """A brick for each box."""
        self.bounds = _content(values[: self.count, 3] > 0)
        """Bounds of the content of each box, as `_content`."""


@dataclasses.dataclass(frozen=True)
class _Tiles:
    """Tiles of a view that have a list of boxes each."""

    side: int
    """Pixels."""
    begin: NDArray[np.int64]
    """Where a tile's list begins [rows, columns]."""
    count: NDArray[np.int64]
    """Boxes in it [rows, columns]; one more entry precedes them."""


class GpuMarch:
    """A picture that is marched in slices; `colour` and `depth` are complete when `advance` returns True.

    Pictures have their bottom row first. `colour` is RGBA16F, linear and premultiplied; `depth` R32F, metres along the
    optical axis to where humans are half opaque, 1e10 where they are not.
    """

    def __init__(
        self,
        shaders: dict[str, gpu.types.GPUShader],
        atlas: gpu.types.GPUTexture,
        atlas_size: tuple[int, int, int],
        records: NDArray[np.float64],
        view: PinholeView,
        spacing: float,
        ends: gpu.types.GPUTexture | None,
    ):
        size = (view.width, view.height)
        self.colour = gpu.types.GPUTexture(size, format="RGBA16F")
        self.depth = gpu.types.GPUTexture(size, format="R32F")
        self._shader, self._size, self._done = shaders["march"], size, 0
        self._columns, self._rows = -(-view.width // TILE), -(-view.height // TILE)
        self._atlas, self._ends, self._count = atlas, ends, len(records)
        base = records[0, 0, 1] // (stride := records[:, 0, 3].max()) * stride if len(records) else 0.0
        records[:, 0, :3] -= base
        self._boxes = _texture(_padded(records), "RGBA32F")
        fine = _tiles(records, view, TILE)
        wide = _tiles(records, view, fine.side * WIDER)
        self._tile_side, self._work = fine.side, _work_of_rows(fine, self._rows)
        wide_tiles, wide_entries = self._list(shaders["list"], wide, len(records), None)
        self._tiles, self._entries = self._list(shaders["list"], fine, -1, (wide_tiles, wide_entries))
        focal = (view.intrinsics[0, 0], view.intrinsics[1, 1])
        self._constants = {
            "lens": (*focal, view.intrinsics[0, 2], view.intrinsics[1, 2]),
            "lattice": (spacing, base, base * spacing - view.depth_offset, atlas_size[1] // VOXELS),
            "planes": tuple(min(edge / spacing, 1e12) - base for edge in view.clip),
            "metric": (focal[0] ** -2, focal[1] ** -2),
            "atlas_size": atlas_size,
        }

    def _list(
        self,
        shader: gpu.types.GPUShader,
        tiles: _Tiles,
        boxes: int,
        wider: tuple[gpu.types.GPUTexture, gpu.types.GPUTexture] | None,
    ) -> tuple[gpu.types.GPUTexture, gpu.types.GPUTexture]:
        """Tiles and their lists, chosen among as many boxes, or out of the lists of wider tiles."""
        rows, columns = tiles.count.shape
        spans = _texture(np.stack([tiles.begin, tiles.count] * 2, -1), "RGBA32F")
        total = int((tiles.count + 1).sum())
        entries = gpu.types.GPUTexture((ENTRIES_A_ROW, -(-total // ENTRIES_A_ROW)), format="R32UI")
        wide_tiles, wide_entries = wider or (spans, gpu.types.GPUTexture((1, 1), format="R32UI"))
        shader.bind()
        for name, texture in (("boxes", self._boxes), ("tiles", spans), ("wide_tiles", wide_tiles)):
            shader.uniform_sampler(name, texture)
        shader.uniform_sampler("entries", wide_entries)
        shader.image("entries_image", entries)
        shader.uniform_int("tiling", (columns, rows, tiles.side, boxes))
        gpu.compute.dispatch(shader, -(-columns // TILE), -(-rows // TILE), 1)
        return spans, entries

    def advance(self, work: float = np.inf) -> bool:
        """March rows of tiles of about this `work`, one at least, from the top; True when the picture is complete.

        Work is what rays may meet: pixels times boxes in their tile.
        """
        wanted = int(np.searchsorted(self._work, self._work[self._done] + work, side="right")) - 1
        rows = min(max(wanted - self._done, 1), self._rows - self._done)
        if rows > 0:
            shader = self._shader
            shader.bind()
            for name, texture in (("boxes", self._boxes), ("tiles", self._tiles), ("entries", self._entries)):
                shader.uniform_sampler(name, texture)
            shader.uniform_sampler("atlas", self._atlas)
            shader.uniform_sampler("ends", self._ends or self._tiles)
            shader.image("colour_image", self.colour)
            shader.image("depth_image", self.depth)
            for name, values in self._constants.items():
                shader.uniform_float(name, values)
            shader.uniform_int("size", self._size)
            tiling = (self._done, self._tile_side, int(self._ends is not None), self._count)
            shader.uniform_int("tiling", tiling)
            gpu.compute.dispatch(shader, self._columns, rows, 1)
            self._done += rows
        return self._done >= self._rows

    def wait(self) -> None:
        """Return when the GPU has finished what it was given."""
        frame = gpu.types.GPUFrameBuffer(color_slots=self.colour)
        with frame.bind():
            frame.read_color(0, 0, 1, 1, 4, 0, "FLOAT")


class GpuMarcher:
    """The shaders, and the common atlas of the humans that were marched last."""

    def __init__(self) -> None:
        """Needs a GPU context. Compiles the shaders: a second, where the driver has not kept them. Raises RuntimeError
        where the GPU cannot march."""
        self._shaders = {name: shader() for name, shader in _SHADERS.items()}
        self._humans: tuple[GpuPayload, ...] = ()
        self._atlas: gpu.types.GPUTexture | None = None
        self._pixels = [gpu.types.GPUTexture((1, 1), format="R32F") for _ in range(2)]

    def march(
        self,
        humans: Sequence[tuple[GpuPayload, Boxes]],
        view: PinholeView,
        step: float,
        ends: gpu.types.GPUTexture | None = None,
    ) -> GpuMarch:
        """Prepare the picture of `humans` from `view`; `advance` marches it. `step` is the distance in metres between
        samples through large boxes of humans of natural size.

        Overlapping boxes are mixed at lattice points, also those of several humans. `ends` holds, as `GpuMarch.depth`
        does, where each pixel's ray ends at other objects.
        """
        self._rebind()
        spacing, strides = _lattice([boxes.density_scale for _, boxes in humans], step)
        size = (ACROSS * VOXELS, max([payload.rows for payload, _ in humans], default=1) * VOXELS)
        atlas_size = (*size, max(len(humans), 1) * VOXELS)
        records = _all_records(humans, view, spacing, strides, atlas_size[1] // VOXELS)
        return GpuMarch(self._shaders, self._common(humans, atlas_size), atlas_size, records, view, spacing, ends)

    def _rebind(self) -> None:
        """Bind other images than the last ones: Blender 5.2 takes a new texture that has got the number of a freed one
        for bound, so that nothing would be written to it."""
        shader = self._shaders["rebind"]
        shader.bind()
        for unit, pixel in enumerate(self._pixels):
            shader.image(f"image_{unit}", pixel)
        gpu.compute.dispatch(shader, 1, 1, 1)

    def _common(self, humans: Sequence[tuple[GpuPayload, Boxes]], size: tuple[int, int, int]) -> gpu.types.GPUTexture:
        """One atlas of all humans, a layer of bricks for each."""
        payloads = tuple(payload for payload, _ in humans)
        if len(payloads) == 1:
            return payloads[0].texture
        if self._atlas is None or payloads != self._humans:
            self._humans, self._atlas = payloads, gpu.types.GPUTexture(size, format="RGBA16F")
            shader = self._shaders["copy"]
            for number, payload in enumerate(payloads):
                shader.bind()
                shader.uniform_sampler("one", payload.texture)
                shader.image("atlas_image", self._atlas)
                shader.uniform_int("layer", number * VOXELS)
                gpu.compute.dispatch(shader, ACROSS, payload.rows, VOXELS)
        return self._atlas


def _content(solid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Bounds [K, 2, 3] in [-1, 1], along T, B, N, of the cells next to voxels with density; upside down where none."""
    bounds = np.empty((len(solid), 2, 3))
    for axis in range(3):
        seen = solid.any(tuple(1 + other for other in range(3) if other != 2 - axis))
        bounds[:, 0, axis] = np.maximum(seen.argmax(1) - 1, 0)
        bounds[:, 1, axis] = np.minimum(VOXELS - seen[:, ::-1].argmax(1), VOXELS - 1)
    bounds[~solid.any((1, 2, 3))] = [[[VOXELS - 1.0], [0.0]]]
    return bounds / (VOXELS - 1) * 2 - 1


def _lattice(density_scales: list[float], step: float) -> tuple[float, list[int]]:
    """Spacing of lattice points and strides for humans of these scales, by powers of two as the backend's
    `settings_for`: the lattice shrinks with the smallest, strides grow with the largest."""
    powers = [round(-np.log2(scale)) for scale in density_scales] or [0]
    doublings = min(max(powers) - min(powers), MOST_DOUBLINGS)
    spacing = step / STRIDES[-1] * 2.0 ** (max(powers) - doublings)
    return spacing, STRIDES + [STRIDES[-1] * 2**i for i in range(1, doublings + 1)]


def _all_records(
    humans: Sequence[tuple[GpuPayload, Boxes]], view: PinholeView, spacing: float, strides: list[int], rows: int
) -> NDArray[np.float64]:
    """Records [N, TEXELS, 4] of all boxes with content in the view, in the order of their first lattice points; `rows`
    is the height of an atlas layer in bricks."""
    parts = [_records(payload, boxes, view, spacing, strides) for payload, boxes in humans]
    for number, (part, shown) in enumerate(parts):
        part[:, 6, 3] = number * rows * ACROSS + shown
    records = np.concatenate([part for part, _ in parts]) if parts else np.zeros((0, TEXELS, 4))
    return records[np.argsort(records[:, 0, 1], kind="stable")]


def _tiles(records: NDArray[np.float64], view: PinholeView, side: int) -> _Tiles:
    """Tiles of `side` pixels, or larger ones where their lists would be too long together."""
    while True:
        across = np.array([-(-view.width // side), -(-view.height // side)])
        count = _counts(records[:, 8].astype(np.int64) // side, across)
        if count.sum() <= MOST_ENTRIES or count.size == 1:
            return _Tiles(side, np.cumsum(count + 1).reshape(count.shape) - (count + 1), count)
        side *= 2


def _work_of_rows(tiles: _Tiles, rows: int) -> NDArray[np.float64]:
    """Work of the first n dispatched rows [rows + 1], each TILE pixels high; a pixel without boxes is work too."""
    row = ((tiles.count + 1) * tiles.side * TILE).sum(1)[np.arange(rows) * TILE // tiles.side]
    return np.concatenate([[0.0], np.cumsum(row)])


def _counts(reach: NDArray[np.int64], across: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many rectangles (first column, row, last column, row) cover each tile [rows, columns]."""
    corners = np.zeros((across[1] + 1, across[0] + 1), np.int64)
    left, top, right, bottom = reach[:, 0], reach[:, 1], reach[:, 2] + 1, reach[:, 3] + 1
    for row, column, sign in ((top, left, 1), (bottom, right, 1), (top, right, -1), (bottom, left, -1)):
        np.add.at(corners, (row, column), sign)
    return corners.cumsum(0).cumsum(1)[:-1, :-1]


def _records(
    payload: GpuPayload, boxes: Boxes, view: PinholeView, spacing: float, strides: list[int]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Records [N, TEXELS, 4] of the boxes with content in the view, and their indices."""
    solid = (payload.bounds[:, 0] < payload.bounds[:, 1]).all(1) & (boxes.half_extent > 0).all(1)
    shown = np.flatnonzero(solid)
    position, rotation = np.asarray(boxes.position, np.float64)[shown], np.asarray(boxes.rotation, np.float64)[shown]
    half, bounds = np.asarray(boxes.half_extent, np.float64)[shown], payload.bounds[shown]
    turn, shift = view.world_to_camera[:, :3], view.world_to_camera[:, 3]
    focal, middle = np.diag(view.intrinsics)[:2], view.intrinsics[:2, 2]
    eye = -turn.T @ shift
    right, down = turn[0] / focal[0], turn[1] / focal[1]

    away = position - eye
    distance = np.linalg.norm(away, axis=1)
    in_camera = position @ turn.T + shift
    ahead = in_camera[:, 2] > distance * _OPTICAL
    slope = np.where(ahead[:, None], in_camera[:, :2] / np.where(ahead, in_camera[:, 2], 1)[:, None], 0)
    n0 = np.where(ahead, np.floor(distance / spacing + 0.5), 0)
    m0 = slope @ turn[:2] + turn[2]
    length = np.linalg.norm(m0, axis=1)
    direction = m0 / length[:, None]
    pixel = np.clip(slope * focal + middle, -_FAR_PIXEL, _FAR_PIXEL)

    def local(vectors: NDArray) -> NDArray:
        return np.einsum("kij,ki->kj", rotation, np.broadcast_to(vectors, position.shape)) / half

    corners = np.where(_CORNERS[None] == 0, bounds[:, None, 0], bounds[:, None, 1]) * half[:, None]
    corners = in_camera[:, None] + np.einsum("kci,kji,lj->kcl", corners, rotation, turn)
    reach = _rectangles(corners, view, spacing * 1e-4)
    eye_inside = -local(away)
    beside = (eye_inside - np.clip(eye_inside, bounds[:, 0], bounds[:, 1])) * half
    first = np.ceil(np.linalg.norm(beside, axis=1) * (1 - 1e-6) / spacing - 0.01)
    last = np.floor(np.linalg.norm(corners, axis=2).max(1) * (1 + 1e-6) / spacing + 0.01)
    depth = corners[:, :, 2]
    seen = (reach[:, :2] <= reach[:, 2:]).all(1) & (depth.max(1) >= view.clip[0]) & (depth.min(1) <= view.clip[1])

    voxel = (2 * half.min(1) / (VOXELS - 1)).astype(np.float32)
    stride = np.ones(len(shown))
    for candidate in strides:
        stride[voxel >= np.float32(candidate * spacing * SAMPLES_PER_VOXEL)] = candidate
    whole = np.floor(pixel)
    record = np.zeros((len(shown), TEXELS, 4))
    record[:, 0] = np.stack([n0, np.maximum(first, 1), last, stride], 1)
    record[:, 1, :3], record[:, 1, 3] = local(right), length
    record[:, 2, :3], record[:, 2, 3] = local(down), 2 * m0 @ right
    record[:, 3, :3], record[:, 3, 3] = local(direction), 2 * m0 @ down
    record[:, 4, :3], record[:, 4, 3] = local(n0[:, None] * spacing * direction - away), n0 * spacing
    record[:, 5, :3], record[:, 5, 3] = bounds[:, 0], stride * spacing * boxes.density_scale
    record[:, 6, :3] = bounds[:, 1]
    record[:, 7, ::2], record[:, 7, 1::2] = whole, 0.5 - (pixel - whole)
    record[:, 8] = reach
    return record[seen], shown[seen]


def _rectangles(corners: NDArray, view: PinholeView, near: float) -> NDArray[np.float64]:
    """First column and row and last column and row of the pixels that see a box with these corners [K, 8, 3] in the
    camera's coordinates, cut at the plane z = `near`; last < first where there are none."""
    low, high = np.full((len(corners), 2), np.inf), np.full((len(corners), 2), -np.inf)
    focal, middle = np.diag(view.intrinsics)[:2], view.intrinsics[:2, 2]

    def grow(points: NDArray, seen: NDArray) -> None:
        depth = np.where(seen, points[..., 2], 1)[..., None]
        pixel = np.clip(points[..., :2] * focal / depth + middle, -_FAR_PIXEL, _FAR_PIXEL)
        np.minimum(low, np.where(seen[..., None], pixel, np.inf).min(1), out=low)
        np.maximum(high, np.where(seen[..., None], pixel, -np.inf).max(1), out=high)

    before = corners[..., 2] >= near
    grow(corners, before)
    cut = before[:, _EDGES[:, 0]] != before[:, _EDGES[:, 1]]
    if cut.any():
        a, b = corners[:, _EDGES[:, 0]], corners[:, _EDGES[:, 1]]
        share = (near - a[..., 2:]) / np.where(cut, b[..., 2] - a[..., 2], 1)[..., None]
        crossing = a + share * (b - a)
        crossing[..., 2] = near
        grow(crossing, cut)
    margin = 0.01 + 1e-6 * np.abs(np.nan_to_num(low, posinf=0))
    first = np.maximum(np.ceil(low - margin - 0.5), 0)
    last = np.minimum(np.floor(high + margin - 0.5), [view.width - 1, view.height - 1])
    return np.concatenate([first, last], 1)


def _padded(records: NDArray) -> NDArray[np.float32]:
    """Records as the rows of a texture [rows, BOXES_A_ROW * TEXELS, 4]."""
    rows = max(-(-len(records) // BOXES_A_ROW), 1)
    padded = np.zeros((rows * BOXES_A_ROW, TEXELS, 4), np.float32)
    padded[: len(records)] = records
    return padded.reshape(rows, -1, 4)


def _texture(values: NDArray, format_: str) -> gpu.types.GPUTexture:
    """A texture of these texels [.., height, width, 4]."""
    flat = np.ascontiguousarray(values, np.float32).ravel()
    return gpu.types.GPUTexture(
        tuple(reversed(values.shape[:-1])), format=format_, data=gpu.types.Buffer("FLOAT", flat.size, flat)
    )


@cache_until_exit
def gpu_marcher() -> GpuMarcher:
    """The marcher of all views, made while the first is drawn. Raises as `GpuMarcher`."""
    return GpuMarcher()
