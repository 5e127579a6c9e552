"""Places of the primitives on the default body, from layout.npz: the inputs of `Anchors` as numpy arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..files.arrays import read_arrays

GRID = 32
"""Primitives along a side of the UV grid; primitive k is at row k // GRID, column k % GRID."""
CHARTS = (
    "torso",
    "head",
    "left_arm",
    "right_arm",
    "left_hand",
    "right_hand",
    "left_leg",
    "right_leg",
    "left_foot",
    "right_foot",
)
"""Regions of the body; `cell_chart` holds indices into this tuple."""

SPACING_TO_HALF_EXTENT = 1.0
"""In-plane half extent relative to the distance to the next cell; 0.5 would tile. Boxes overlap because the marcher's
window fades the outer fifth of a box, and neighbouring boxes diverge where cloth hangs off the skin: of the surface of
eight dressed humans 94 % lies in the unfaded part of some box at 0.75, 97 % at 0.9, 97.6 % at 1.0 (coarser voxels)."""
SMALLEST_IN_PLANE = 0.008
"""Metres; gives voxels of about 2 mm, finer than any rendering needs."""
LARGEST_IN_PLANE = {"torso": 0.050, "head": 0.050, "arm": 0.050, "hand": 0.035, "leg": 0.050, "foot": 0.050}
"""Metres, by region. Cells at the thumb span the gap to the fingers, which one coarse box would fill."""
NORMAL_HALF_EXTENT = {"torso": 0.055, "head": 0.055, "arm": 0.045, "hand": 0.025, "leg": 0.060, "foot": 0.040}
"""Metres along the normal, by region. Jackets, skirts and hair are 4-6 cm away from the skin; surface outside all boxes
is missing from the result. Sleeves and shoes are closer, and a hand's eight voxels must resolve fingers 2 cm thick."""
LARGEST_STRETCH = 1.6
"""Factor up to which a box grows in its plane when a pose stretches the skin under it. Only about ten boxes, at the
groin of a raised leg, stretch further."""


def body_data(name: str) -> Path:
    """body.npz or layout.npz of the default body, which every build has. Raises FileNotFoundError."""
    path = Path(__file__).resolve().parents[1] / "body" / "data" / name
    if not path.is_file():
        raise FileNotFoundError(f"{name} of the default body is missing: install the program again")
    return path


def read_layout(path: Path) -> dict[str, NDArray]:
    """cell_face [K], cell_barycentric [K, 3], cell_chart [K], texel_face [H, W] and texel_barycentric [H, W, 3].

    Integers are int64, weights float64. Raises FileError and OSError.
    """
    stored = read_arrays(path, ("cell_face", "cell_barycentric", "cell_chart", "texel_face", "texel_barycentric"))
    layout = {name: values.astype(np.float64 if "barycentric" in name else np.int64) for name, values in stored.items()}
    first, second = np.moveaxis(layout["texel_barycentric"] / 65535, -1, 0)
    return {**layout, "texel_barycentric": np.stack([first, second, 1 - first - second], -1)}


def stencils(faces: NDArray, texel_face: NDArray, texel_barycentric: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Vertices [K, m] and their weights in dP/du and dP/dv [K, m], padded with weight 0, of tangent planes that are
    averaged over the cells of texels; from faces [F, 3] and the face [H, W] and barycentric [H, W, 3] of every texel.

    dP/du of a cell is the mean of its last column of texels minus the mean of its first, scaled to the cell's width;
    dP/dv likewise along rows.
    """
    side = len(texel_face) // GRID

    def cells(texels: NDArray) -> NDArray:
        parts = texels.reshape(GRID, side, GRID, side, *texels.shape[2:])
        return parts.swapaxes(1, 2).reshape(GRID * GRID, side, side, *texels.shape[2:])

    weight = cells(texel_barycentric) / (side - 1)
    rise = np.zeros(side, weight.dtype)
    rise[0], rise[-1] = -1, 1
    vertex = faces[cells(texel_face)].reshape(GRID * GRID, -1)
    du, dv = ((weight * along).reshape(GRID * GRID, -1) for along in (rise[None, :, None], rise[:, None, None]))
    row, column = np.nonzero((du != 0) | (dv != 0))
    count = int(vertex.max()) + 1
    unique, index = np.unique(row * count + vertex[row, column], return_inverse=True)
    row_of, first = unique // count, np.searchsorted(unique, np.arange(GRID * GRID) * count)
    place = (row_of, np.arange(len(unique)) - first[row_of])
    shape = (GRID * GRID, int(place[1].max()) + 1)
    merged_vertex, merged_du, merged_dv = np.zeros(shape, np.int64), np.zeros(shape), np.zeros(shape)
    merged_vertex[place] = unique % count
    for merged, part in ((merged_du, du), (merged_dv, dv)):
        merged[place] = np.bincount(index.ravel(), part[row, column], len(unique))
    return merged_vertex, merged_du, merged_dv


def half_extents(du: NDArray, dv: NDArray, chart: NDArray) -> NDArray:
    """Half extents [K, 3] along T, B, N, metres: in-plane from dP/du and dP/dv [K, 3] of the template (paper sec. 3.1),
    along the normal by the region `chart` [K]."""
    limits = [(LARGEST_IN_PLANE[region], NORMAL_HALF_EXTENT[region]) for region in (c.split("_")[-1] for c in CHARTS)]
    largest, depth = np.array(limits, du.dtype)[chart].T
    in_plane = SPACING_TO_HALF_EXTENT * np.stack([np.linalg.norm(du, axis=-1), np.linalg.norm(dv, axis=-1)], -1)
    in_plane = np.minimum(np.maximum(in_plane, du.dtype.type(SMALLEST_IN_PLANE)), largest[:, None])
    return np.concatenate([in_plane, depth[:, None]], -1)
