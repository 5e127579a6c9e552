"""What a checkpoint can be asked for, read from its file without torch: the backend writes it into the metadata."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from ..formats.json_files import parse_json
from ..formats.regular_files import as_file_error, open_regular
from ..formats.tensor_layout import check_limits, read_layout

_LARGEST_FILE = 16 << 30
"""Bytes, as in the backend's `tensor_file`."""
_LARGEST_NUMBER = 1e9


@dataclasses.dataclass(frozen=True)
class Vocabulary:
    """Attributes that a model knows; none for one that was trained without."""

    categories: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    """Name -> values to choose from: sex, outfit, hair."""
    scalars: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    """Name -> mean and standard deviation: height in metres, weight in kilograms."""


def read_vocabulary(path: Path) -> Vocabulary:
    """The vocabulary of a checkpoint; an empty one where the file has none.

    Raises OSError for a file that cannot be read and ValueError for one that is no checkpoint.
    """
    with as_file_error(path, "is damaged or no checkpoint of a diffusion model", "choose another file"):
        with open_regular(path, _LARGEST_FILE) as file:
            layout = read_layout(file)
        check_limits(layout)
        tree = parse_json(layout.metadata["architecture"]).get("vocabulary") or {}
        categories = {name: tuple(map(str, values)) for name, values in tree.get("categories", {}).items()}
        scalars = {name: (float(mean), float(std)) for name, (mean, std) in tree.get("scalars", {}).items()}
        if not all(abs(mean) <= _LARGEST_NUMBER and 0 < std <= _LARGEST_NUMBER for mean, std in scalars.values()):
            raise ValueError("a mean or standard deviation that no quantity has")
    return Vocabulary(categories, scalars)
