"""The part of .human files that both programs share: the metadata, which state the format's version and the human's
origin, and the compact form, with colours and densities in eight bits."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from ..files.json_files import parse_json
from .schema import FieldError, Open, Range, read

COMPACT_VERSION = 3
"""Format version of compact .human files, on any body."""
COMPACT_SCALES = "compact"
"""Metadata of compact files: JSON, the linear colour and the density (1/m) that are stored as 255."""
_LEVELS = 255
LARGEST_VALUE = 65504.0
"""Largest colour, density and size of a box: larger ones overflow in half precision."""
_KNEE = 12.92 * 0.0031308


@dataclasses.dataclass(frozen=True, kw_only=True)
class Edit(Open):
    """A later edit."""

    edit: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class Provenance(Open):
    """Origin of a human; a file need not state all of it, and may state more."""

    seed: int = 0
    steps: int = 0
    sampler: str = ""
    guidance: float = 1.0
    attributes: dict[str, str | float] = dataclasses.field(default_factory=dict)
    checkpoint: str = ""
    checkpoint_sha256: str = ""
    full_density: Annotated[float, Range(1e-30, 1e30)] = 1.0
    version: str = ""
    edits: list[Edit] = dataclasses.field(default_factory=list)


def version_fault(metadata: Mapping[str, str]) -> tuple[str, str] | None:
    """Why a file's version cannot be read, if so: reason and remedy of a FileError."""
    version = metadata.get("format_version", "")
    newest = COMPACT_VERSION
    if not (version.isascii() and version.isdecimal() and len(version) <= 9) or int(version) < 1:
        return f"does not contain a valid human (format version {version!r:.9})", "generate it again"
    if int(version) > newest:
        return f"has format {version} of a newer PrimDiffusion, this one reads up to {newest}", "update PrimDiffusion"
    return None


def provenance_of(metadata: Mapping[str, str]) -> dict[str, Any]:
    """Origin of the human. Raises ValueError for what is not a JSON object or has entries of a wrong type."""
    try:
        provenance = parse_json(metadata.get("provenance", ""))
    except ValueError as error:
        raise ValueError(f"its provenance is not JSON ({error!s:.100})") from error
    check_provenance(provenance)
    return provenance


def check_provenance(provenance: Any) -> None:
    """Raise ValueError, naming the entry, for one of a wrong type."""
    if not isinstance(provenance, Mapping):
        raise ValueError(f"its provenance is {provenance!r:.60}, not a JSON object")
    try:
        read(Provenance, provenance)
    except FieldError as error:
        raise ValueError(f"{error.field!r} of its provenance is not valid") from error


def to_eight_bits(rgb: NDArray, density: NDArray) -> tuple[NDArray[np.uint8], NDArray[np.uint8], str]:
    """Linear colours, sRGB-encoded, and densities (1/m), as square roots, in eight bits; and the metadata to read them.

    Square roots resolve thin haze, which adds up along a ray; dense voxels are opaque anyway. Negative values become 0.
    """
    scales = {"rgb": max(float(rgb.max()), 1.0), "density": max(float(density.max()), 1e-6)}
    linear = np.clip(rgb / scales["rgb"], 0, 1)
    power = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, power)
    root = np.sqrt(np.clip(density / scales["density"], 0, 1))
    colour, opacity = (np.round(values * _LEVELS).astype(np.uint8) for values in (encoded, root))
    return colour, opacity, json.dumps(scales)


def from_eight_bits(arrays: Mapping[str, NDArray], metadata: str) -> dict[str, NDArray]:
    """`arrays` with rgb and density as float32 again. Raises ValueError for metadata or arrays of another kind."""
    try:
        stored = parse_json(metadata)
        scales = {name: float(stored[name]) for name in ("rgb", "density")}
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"its metadata {COMPACT_SCALES!r} is {metadata:.60}, not two scales") from error
    if not all(0 < scale <= LARGEST_VALUE for scale in scales.values()):
        raise ValueError(f"its metadata {COMPACT_SCALES!r} has scales out of range")
    if wrong := [name for name in scales if arrays[name].dtype != np.uint8]:
        raise ValueError(f"{wrong[0]!r} is not in eight bits")
    level = np.arange(_LEVELS + 1) / _LEVELS
    colour = np.where(level <= _KNEE, level / 12.92, ((np.maximum(level, _KNEE) + 0.055) / 1.055) ** 2.4)
    tables = {"rgb": colour * scales["rgb"], "density": level**2 * scales["density"]}
    return {**arrays, **{name: np.asarray(table.astype(np.float32)[arrays[name]]) for name, table in tables.items()}}
