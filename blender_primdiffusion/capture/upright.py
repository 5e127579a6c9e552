"""How large a scan is and which way it stands: units and axes of files, told from the person in them."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ..scene.convention import BLENDER_FROM_BACKEND
from .scan_files import ScanError

SHORTEST, TALLEST = 0.5, 2.6
"""People's heights in metres, toddlers to giants with hats: less than a power of ten apart."""
_WIDEST = 10.0
"""Metres that a person with whatever it holds may reach: one stray vertex would send the cameras far away."""
_UNITS = {1.0: "", 0.01: "centimetres", 0.001: "millimetres", 100.0: "hundreds of metres", 1000.0: "kilometres"}


@dataclasses.dataclass(frozen=True)
class Standing:
    """What turns and scales an imported scan into metres, z up, facing -y."""

    rotation: NDArray[np.float64]
    """[3, 3], Blender's axes."""
    scale: float
    notes: list[str]


def stand_up(axes: NDArray, points: NDArray, name: str) -> Standing:
    """From the columns left, up and front [3, 3] of a person and its surface [V, 3], as imported into Blender.

    Raises ScanError where no power of ten makes it a person's height.
    """
    rotation = BLENDER_FROM_BACKEND @ np.asarray(axes).T
    up = np.asarray(axes)[:, 1]
    along = np.asarray(points) @ up
    height = float(along.max() - along.min())
    scale = unit_of(height, name)
    reach = float(np.ptp(points, axis=0).max()) * scale
    if not reach <= _WIDEST:
        raise ScanError(f"{name} has points {reach:.4g} m apart: remove what is not the person, or lost vertices")
    notes = [f"{height * scale:.2f} m tall", scale_note(scale)]
    tilt = np.degrees(np.arccos(np.clip(up[2], -1, 1)))
    if tilt > 1:
        notes.append(f"{axis_name(up)} was up after import: turned upright")
    yaw = np.degrees(np.arctan2(rotation[1, 0], rotation[0, 0])) if tilt <= 1 else 0.0
    if abs(yaw) > 1:
        notes.append(f"turned by {yaw:.0f} degrees to face forward")
    return Standing(rotation, scale, [note for note in notes if note])


def unit_of(height: float, name: str) -> float:
    """The power of ten that makes `height` a person's in metres. Raises ScanError where there is none."""
    for scale in (1.0, 0.01, 100.0, 0.001, 1000.0, 0.1, 10.0):
        if SHORTEST <= height * scale <= TALLEST:
            return scale
    raise ScanError(
        f"{name} is {height:.4g} m tall, and no change of units makes that a person of {SHORTEST:g} to {TALLEST:g} m: "
        "scale it to metres"
    )


def scale_note(scale: float) -> str:
    """What to tell about a scale that was corrected; empty where there is nothing to tell."""
    if scale == 1.0:
        return ""
    unit = (
        f"its unit seems to be {_UNITS[scale]}"
        if scale in _UNITS
        else "it is ten times too " + ("large" if scale < 1 else "small")
    )
    return f"scaled by {scale:g}: {unit}"


def axis_name(direction: NDArray) -> str:
    """The axis nearest to a direction, such as "z" or "-y"."""
    largest = int(np.abs(direction).argmax())
    return ("-" if direction[largest] < 0 else "") + "xyz"[largest]
