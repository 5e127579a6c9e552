"""Ranges of what requests say. Imports no torch."""

from __future__ import annotations

import math
from typing import Any

LARGEST_SEED = 2**63 - 1
STEP_LIMIT = 1000
"""The schedule's length: a sampler cannot take more steps."""
LARGEST_STEP_PICTURE = 1024
"""Pixels a side: a larger picture would hold up sampling, and cancelling."""
LARGEST_NUMBER = 1e30
"""Products of larger ones do not fit into float32."""


def check_seed(seed: int) -> None:
    """ValueError outside 0 ... 2^63-1."""
    if not 0 <= seed <= LARGEST_SEED:
        raise ValueError(f"seed {seed} is outside 0 ... 2^63-1")


def check_steps(steps: int) -> None:
    """ValueError outside 1 ... STEP_LIMIT."""
    if not 1 <= steps <= STEP_LIMIT:
        raise ValueError(f"{steps} steps were asked for: choose 1 to {STEP_LIMIT}")


def check_size(size: int) -> None:
    """ValueError for a picture without pixels."""
    if size < 1:
        raise ValueError(f"pictures of {size} pixels a side: choose 1 or more")


def check_sides(width: int, height: int) -> None:
    """ValueError for a picture without pixels."""
    if min(width, height) < 1:
        raise ValueError(f"a picture of {width} x {height} pixels: choose sides of 1 or more")


def check_picture_px(picture_px: int) -> None:
    """ValueError outside 0 ... LARGEST_STEP_PICTURE."""
    if not 0 <= picture_px <= LARGEST_STEP_PICTURE:
        raise ValueError(f"picture_px is {picture_px}: choose 0, for no pictures, to {LARGEST_STEP_PICTURE}")


def check_attributes(attributes: dict[str, Any], guidance: float) -> None:
    """ValueError unless the values are texts and finite numbers; which ones there are, the checkpoint knows."""
    for name, value in attributes.items():
        if not name or value == "":
            raise ValueError(f"{name or value!r} is no attribute: write NAME=VALUE, as in outfit=suit or height=1.8")
        if isinstance(value, list):
            raise ValueError(f"the attribute {name!r} is given twice: give it once")
        number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if not (isinstance(value, str) or number):
            raise ValueError(f"the attribute {name!r} is {value!r:.40}: give a text or a number")
    if not math.isfinite(guidance):
        raise ValueError(f"guidance is {guidance}: give a number, 1 for none")


def check_voxel(voxel: float) -> None:
    """ValueError unless this is a length."""
    if not (math.isfinite(voxel) and voxel > 0):
        raise ValueError(f"voxel is {voxel}: give the side of a voxel in metres, above zero")


def check_angle(name: str, angle: float, unit: str) -> None:
    """ValueError for NaN and infinite angles."""
    if not math.isfinite(angle):
        raise ValueError(f"{name} is {angle}: give an angle in {unit}")


def check_betas(betas: list | None) -> None:
    """ValueError unless it is a list of numbers, or None."""
    if betas is not None:
        check_numbers("betas", betas, (len(betas),))


def check_numbers(name: str, value: Any, shape: tuple[int, ...]) -> None:
    """ValueError that names `name` unless `value` is nested lists of this shape, of numbers that float32 can hold."""
    if not shape:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{name} holds {value!r:.40} where a number should be")
        if not -LARGEST_NUMBER <= value <= LARGEST_NUMBER:
            raise ValueError(f"{name} holds {value!r:.40}: give finite numbers, of at most {LARGEST_NUMBER:g}")
        return
    if not isinstance(value, list) or len(value) != shape[0]:
        given = f"{len(value)} entries" if isinstance(value, list) else f"{value!r:.40}"
        raise ValueError(f"{name} holds {given} where {' x '.join(map(str, shape))} numbers should be")
    for entry in value:
        check_numbers(name, entry, shape[1:])
