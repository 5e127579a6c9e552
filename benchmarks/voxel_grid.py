"""Humans as 64^3 voxel grids in T pose: the representation that the paper's Table 2 compares primitives with.

All grids share one bounding box. The marcher renders a grid as one large primitive.
"""

from __future__ import annotations

import math

import numba
import numpy as np
import torch
from jaxtyping import Float, UInt8
from primdiffusion.geometry.srgb import decode_srgb, encode_srgb
from primdiffusion.primitives.primitives import WINDOW_POWER, WINDOW_SHARPNESS, Frames, Payload, Primitives
from torch import Tensor

SIDE = 64
"""Voxels along each axis (paper Table 2)."""
SAMPLES = (3, 3, 1)
"""Samples along x, y, z that a voxel averages: voxels are wide in x and y and thin in depth."""
FAINT = 1e-3
"""Colour weight of empty samples, relative to full density: gives empty voxels the colour of the boxes around them."""
UNSEEN = 0.5
"""Encoded colour of voxels outside all boxes."""
FACE = 0.96
"""Local coordinate beyond which the grid is always empty; the marcher's window is not compensated there."""

BOUNDS = ((-1.06, -1.43, -0.21), (1.06, 0.81, 0.30))
"""Lowest and highest corner of the bounding box, metres from the pelvis: centres of the outermost voxels. The boxes of
a thousand samples span (-1.01, -1.36, -0.19) to (1.01, 0.75, 0.27); symmetric in x, so that grids can be mirrored."""


def voxelise(
    frames: Frames, rgb: Float[Tensor, "n k 3 s s s"], density: Float[Tensor, "k s s s"], full: float
) -> UInt8[Tensor, "n 64 64 64 4"]:
    """Voxelise one geometry in n colourings: grids (z, y, x) of encoded colour and density / `full`.

    A voxel averages the marcher's field (SPEC 4) over `SAMPLES` points: the sum of the boxes' windowed densities, and
    their density-weighted colour.
    """
    colours = rgb.movedim(0, 1).flatten(1, 2)
    values = torch.cat([density[:, None], colours], dim=1).movedim(1, -1).contiguous().float().numpy()
    low, high = (np.array(corner) for corner in BOUNDS)
    fine = np.array(SAMPLES) * (SIDE - 1) / (high - low)
    total = np.zeros((SIDE, SIDE, SIDE, values.shape[-1] + 1), np.float32)
    _gather(
        total,
        values,
        frames.position.double().numpy(),
        frames.rotation.double().numpy(),
        frames.half_extent.double().numpy(),
        low,
        fine,
        np.array(SAMPLES),
        full * FAINT,
    )
    grid = torch.from_numpy(total)
    weight = grid[..., -1:]
    colour = torch.where(weight > 0, encode_srgb((grid[..., 1:-1] / weight.clamp_min(1e-9)).clamp(0, 1)), UNSEEN)
    opacity = (grid[..., :1] / (math.prod(SAMPLES) * full)).clamp(0, 1)
    grids = [torch.cat([part, opacity], dim=-1) for part in colour.split(3, dim=-1)]
    return (torch.stack(grids) * 255).round().to(torch.uint8)


@numba.njit(cache=True, nogil=True)
def _gather(total, values, position, rotation, half_extent, low, fine, samples, faint):
    """Accumulate each box's density, weighted colours and weights at the fine points inside it."""
    side, size, channels = total.shape[0], values.shape[1], values.shape[-1]
    first, last, local = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3)
    corner, far = np.empty(3, np.int64), np.empty(3)
    value = np.empty(channels)
    for k in range(len(position)):
        for axis in range(3):
            reach = 0.0
            for j in range(3):
                reach += abs(rotation[k, axis, j]) * half_extent[k, j]
            shift = samples[axis] // 2
            first[axis] = max(int(np.ceil((position[k, axis] - reach - low[axis]) * fine[axis])) + shift, 0)
            last[axis] = min(
                int(np.floor((position[k, axis] + reach - low[axis]) * fine[axis])) + shift, side * samples[axis] - 1
            )
        for iz in range(first[2], last[2] + 1):
            for iy in range(first[1], last[1] + 1):
                for ix in range(first[0], last[0] + 1):
                    x = low[0] + (ix - samples[0] // 2) / fine[0] - position[k, 0]
                    y = low[1] + (iy - samples[1] // 2) / fine[1] - position[k, 1]
                    z = low[2] + (iz - samples[2] // 2) / fine[2] - position[k, 2]
                    inside, fading = True, 0.0
                    for j in range(3):
                        local[j] = (rotation[k, 0, j] * x + rotation[k, 1, j] * y + rotation[k, 2, j] * z) / (
                            half_extent[k, j]
                        )
                        if abs(local[j]) >= 1:
                            inside = False
                            break
                        fading += local[j] ** WINDOW_POWER
                    if not inside:
                        continue
                    for j in range(3):
                        place = (local[j] + 1) / 2 * (size - 1)
                        corner[j] = min(int(place), size - 2)
                        far[j] = place - corner[j]
                    value[:] = 0.0
                    for d in range(2):
                        for h in range(2):
                            for w in range(2):
                                share = (
                                    (far[0] if w else 1 - far[0])
                                    * (far[1] if h else 1 - far[1])
                                    * (far[2] if d else 1 - far[2])
                                )
                                voxel = values[k, corner[2] + d, corner[1] + h, corner[0] + w]
                                for c in range(channels):
                                    value[c] += share * voxel[c]
                    window = np.exp(-WINDOW_SHARPNESS * fading)
                    weight = window * (value[0] + faint)
                    cell = total[iz // samples[2], iy // samples[1], ix // samples[0]]
                    cell[0] += window * value[0]
                    for c in range(1, channels):
                        cell[c] += weight * value[c]
                    cell[channels] += weight


def voxelise_payload(frames: Frames, payload: Payload, full: float) -> UInt8[Tensor, "64 64 64 4"]:
    """Voxelise one human, including its delta scales."""
    placed = Primitives.place(frames, payload)
    boxes = Frames(placed.position, placed.rotation, placed.half_extent)
    return voxelise(boxes, payload.rgb[None], payload.density, full)[0]


def primitives_of(grid: Float[Tensor, "64 64 64 4"], full: float) -> Primitives:
    """Convert a grid (clamped to [0, 1]) to one primitive for `march`.

    The marcher's window fades boxes towards their faces; densities are divided by it to compensate.
    """
    grid = grid.clamp(0, 1)
    low, high = torch.tensor(BOUNDS, dtype=grid.dtype)
    along = torch.linspace(-1, 1, SIDE, dtype=grid.dtype).clamp(-FACE, FACE).pow(WINDOW_POWER)
    z, y, x = torch.meshgrid(along, along, along, indexing="ij")
    unfade = (WINDOW_SHARPNESS * (x + y + z)).exp()
    return Primitives(
        position=((low + high) / 2)[None],
        rotation=torch.eye(3, dtype=grid.dtype)[None],
        half_extent=((high - low) / 2)[None],
        rgb=decode_srgb(grid[..., :3]).movedim(-1, 0)[None].contiguous(),
        density=(grid[..., 3] * full * unfade)[None],
    )
