"""The built-in poses, which both programs capture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...files.json_files import read_json
from ..joints import JOINT_NAMES

FILE = Path(__file__).with_suffix(".json")
"""72 axis-angle values by name; written by scripts/bake_poses."""


def built_in_vectors() -> dict[str, NDArray[np.float64]]:
    """Axis-angle vectors [24, 3] by name, radians, y up, relative to the parents; the first is near T."""
    return {name: np.reshape(values, (len(JOINT_NAMES), 3)) for name, values in read_json(FILE).items()}
