"""Primitives to one grid of voxels, for renderers that draw a volume fast and a thousand of them slowly."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from primdiffusion.formats.requests import VOXEL
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.cpu_compiled import on_all_threads
from primdiffusion.render.cpu_merge import sum_boxes

POINTS = 2
"""Places along a voxel's side at which the primitives are read."""
MOST_VOXELS = 2**27
"""Of a grid: 2 GB. A person of 1.8 m takes 5 million at 6 mm."""
FULLEST = 1.0
"""Opacity a voxel may have along its side. More cannot be seen in the additive, clamped rule, and would spread over the
empty voxels next to it where a renderer interpolates."""
FAINTEST = 0.05
"""Opacity per metre below which a voxel is empty."""


@dataclasses.dataclass(frozen=True)
class Merged:
    """One grid in the axes of the primitives; what lies outside it is empty."""

    density: Float[ndarray, "x y z"]
    """Opacity per metre, the window and all overlapping primitives in it; float32."""
    colour: Float[ndarray, "x y z 3"]
    """Linear RGB; empty voxels next to others have their colour, so that interpolation does not darken the rim."""
    origin: Float[ndarray, "3"]
    """The centre of voxel [0, 0, 0], metres: a whole number of voxels, so that several poses share a lattice."""
    voxel: float
    """Their side, metres."""


def merge(primitives: Primitives, voxel: float = VOXEL, points: int = POINTS) -> Merged:
    """All of `primitives` (unbatched) in one grid.

    A voxel's density is the mean of sum_i d_i w_i over points^3 places in it (d: trilinear, w: the window; SPEC 4), at
    most FULLEST / voxel; its colour sum d_i w_i c_i / sum d_i w_i: what the additive rule adds at one sample. Boxes
    with an extent of zero or less hold nothing. Not differentiable. Raises ValueError for a voxel that is not positive,
    or so small that the grid would have more than MOST_VOXELS, and for a batch.
    """
    if primitives.density.ndim != 4:
        raise ValueError(
            f"the primitives are a batch {tuple(primitives.density.shape[:-4])}: merge one person at a time"
        )
    if not voxel > 0:
        raise ValueError(f"the voxel is {voxel} m: give a size above zero")
    boxes = _boxes(primitives)
    position, rotation, half = boxes.position, boxes.rotation, boxes.half_extent
    middle = position + (rotation @ (half * (boxes.low + boxes.high) / 2)[..., None])[..., 0]
    reach = (np.abs(rotation) @ (half * (boxes.high - boxes.low) / 2)[..., None])[..., 0]
    low = np.floor((middle - reach) / voxel).astype(np.int64)
    high = np.ceil((middle + reach) / voxel).astype(np.int64) + 1
    first = low.min(0) - 1 if len(low) else np.zeros(3, np.int64)
    shape = tuple((high.max(0) - first + 1).tolist()) if len(low) else (1, 1, 1)
    if np.prod(shape, dtype=np.float64) > MOST_VOXELS:
        fitting = voxel * float(np.prod(shape, dtype=np.float64) / MOST_VOXELS) ** (1 / 3)
        raise ValueError(
            f"voxels of {voxel * 1000:.3g} mm make a grid of {shape}: choose {fitting * 1000:.2g} mm or more"
        )
    density, colour = np.zeros(shape, np.float32), np.zeros((*shape, 3), np.float32)
    to_local = np.swapaxes(rotation, -1, -2) / half[..., None]
    on_all_threads(
        sum_boxes, position, to_local, low - first, high - first, boxes.voxels, first * voxel, voxel, points,
        density, colour,
    )  # fmt: skip
    return Merged(*_finished(density, colour, FULLEST / voxel), first * voxel, voxel)


class _Boxes(NamedTuple):
    """Boxes that hold something, in float64; y in [-1, 1]^3 are places in a box."""

    position: ndarray
    rotation: ndarray
    half_extent: ndarray
    low: ndarray
    """Where in y a box begins to hold density [K, 3]; most are empty outside the skin."""
    high: ndarray
    voxels: ndarray
    """[K, D, H, W, 4]: red, green, blue, density; float32."""


def _boxes(primitives: Primitives) -> _Boxes:
    solid = (primitives.half_extent > 0).all(-1) & (primitives.density > 0).flatten(-3).any(-1)
    density = primitives.density[solid]
    voxels = torch.cat([primitives.rgb[solid], density[:, None]], 1).movedim(1, -1).float().contiguous()
    position, rotation, half = (
        getattr(primitives, name)[solid].detach().double().cpu().numpy()
        for name in ("position", "rotation", "half_extent")
    )
    low, high = np.empty((2, len(density), 3))
    full = density.detach().cpu().numpy() > 0
    for axis in range(3):
        row = full.any(tuple(1 + other for other in range(3) if other != 2 - axis))
        last = row.shape[1] - 1
        low[:, axis] = np.maximum(row.argmax(1) - 1, 0) / last * 2 - 1
        high[:, axis] = np.minimum(last - row[:, ::-1].argmax(1) + 1, last) / last * 2 - 1
    return _Boxes(position, rotation, half, low, high, voxels.detach().cpu().numpy())


def _finished(density: ndarray, colour: ndarray, fullest: float) -> tuple[ndarray, ndarray]:
    """Density with its limits and colour that is no longer weighted, spread to the empty voxels around."""
    empty = density < FAINTEST
    density[empty], colour[empty] = 0, 0
    weight, around = _around(density), _around(colour)
    near = empty & (weight > 0)
    colour[near] = around[near] / weight[near][:, None]
    colour[~empty] /= density[~empty][:, None]
    return np.minimum(density, np.float32(fullest)), colour


def _around(values: ndarray) -> ndarray:
    """Sums over the 3 x 3 x 3 voxels around each; the outermost are empty."""
    for axis in range(3):
        moved = np.moveaxis(values, axis, 0)
        total = moved.copy()
        total[1:] += moved[:-1]
        total[:-1] += moved[1:]
        values = np.moveaxis(total, 0, axis)
    return values
