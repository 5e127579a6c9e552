"""Colours and densities of a human in eight bits: the compact form of .human files."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from .json_files import parse_json

FORMAT_VERSION = 3
"""Of compact .human files, on any body."""
METADATA = "compact"
"""Name of the metadata of compact files: JSON, the linear colour and the density (1/m) that are stored as 255."""
LEVELS = 255
LARGEST_VALUE = 65504.0
"""Of colours, densities and sizes of boxes: larger ones overflow in half precision."""
_KNEE = 12.92 * 0.0031308


def compact(rgb: NDArray, density: NDArray) -> tuple[NDArray[np.uint8], NDArray[np.uint8], str]:
    """Linear colours, sRGB-encoded, and densities (1/m), as square roots, in eight bits; and the metadata to read them.

    Square roots resolve thin haze, which adds up along a ray; dense voxels are opaque anyway. Negative values become 0.
    """
    scales = {"rgb": max(float(rgb.max()), 1.0), "density": max(float(density.max()), 1e-6)}
    linear = np.clip(rgb / scales["rgb"], 0, 1)
    power = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, power)
    root = np.sqrt(np.clip(density / scales["density"], 0, 1))
    colour, opacity = (np.round(values * LEVELS).astype(np.uint8) for values in (encoded, root))
    return colour, opacity, json.dumps(scales)


def expand(arrays: Mapping[str, NDArray], metadata: str) -> dict[str, NDArray]:
    """`arrays` with rgb and density as float32 again. Raises ValueError for metadata or arrays of another kind."""
    try:
        stored = parse_json(metadata)
        scales = {name: float(stored[name]) for name in ("rgb", "density")}
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"its metadata {METADATA!r} is {metadata:.60}, not two scales") from error
    if not all(0 < scale <= LARGEST_VALUE for scale in scales.values()):
        raise ValueError(f"its metadata {METADATA!r} has scales out of range")
    if wrong := [name for name in scales if arrays[name].dtype != np.uint8]:
        raise ValueError(f"{wrong[0]!r} is not in eight bits")
    level = np.arange(LEVELS + 1) / LEVELS
    colour = np.where(level <= _KNEE, level / 12.92, ((np.maximum(level, _KNEE) + 0.055) / 1.055) ** 2.4)
    tables = {"rgb": colour * scales["rgb"], "density": level**2 * scales["density"]}
    return {**arrays, **{name: np.asarray(table.astype(np.float32)[arrays[name]]) for name, table in tables.items()}}
