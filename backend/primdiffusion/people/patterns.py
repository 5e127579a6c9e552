"""Two-colour patterns of clothes, as functions of the rest position.

Each pattern takes rest positions on the average body (metres, arms level) and returns the weight of the second colour,
0 to 1. Phases are fixed and features are at least a few centimetres wide: voxels of about one centimetre cannot
represent more detail, and a network could not learn random phases.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

Pattern = Callable[[Float[np.ndarray, "*b 3"]], Float[np.ndarray, "*b"]]

SHOULDER_X, SHOULDER_Y, EDGE = 0.2, 0.254, 0.003
"""Start of the sleeves, height of the arms, and half width of soft edges, metres."""


def hanging_height(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Height with the arms hanging down, along which bands are drawn, metres."""
    along_arm = np.abs(position[..., 0]) - SHOULDER_X
    return np.where(along_arm > 0, np.minimum(position[..., 1], SHOULDER_Y) - along_arm, position[..., 1])


def bands(position: Float[np.ndarray, "*b 3"], period: float = 0.14) -> Float[np.ndarray, "*b"]:
    """Horizontal stripes around body and sleeves."""
    return _soft(_wave(hanging_height(position) / period) - 0.25, EDGE / period)


def plaid(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Crossing bands: weight 1 at crossings, 0.5 elsewhere on a band."""
    across = np.where(np.abs(position[..., 0]) > SHOULDER_X, position[..., 2], position[..., 0])
    along = _soft(_wave(across / 0.12) - 0.25, EDGE / 0.12)
    return 0.5 * (bands(position, 0.12) + along)


def dots(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Large dots in staggered rows, projected from the front."""
    row = np.floor(position[..., 1] / 0.08)
    x = position[..., 0] / 0.1 + 0.5 * (row % 2)
    distance = np.hypot((x - np.rint(x)) * 0.1, position[..., 1] - (row + 0.5) * 0.08)
    return _soft(0.026 - distance, EDGE)


def sleeves(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Sleeves in the second colour."""
    # Excludes the hips, which can be as wide.
    raised = position[..., 1] > SHOULDER_Y - 0.25
    return np.where(raised, _soft(np.abs(position[..., 0]) - SHOULDER_X + 0.02, EDGE), 0)


def yoke(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Shoulders and arms in the second colour, down to the chest."""
    return _soft(position[..., 1] - (SHOULDER_Y - 0.1), EDGE)


def chest_band(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """One wide band around the chest and both upper arms."""
    return _soft(0.06 - np.abs(hanging_height(position) - (SHOULDER_Y - 0.14)), EDGE)


SOLID_SHARE = 0.7
PATTERNS: tuple[tuple[str, Pattern], ...] = (
    ("sleeves", sleeves),
    ("yoke", yoke),
    ("chest band", chest_band),
    ("bands", bands),
    ("plaid", plaid),
    ("dots", dots),
)


def _wave(phase: np.ndarray) -> np.ndarray:
    """A triangle wave of period 1 between 0 and 0.5."""
    return np.abs(phase - np.rint(phase))


def _soft(signed: np.ndarray, width: float) -> np.ndarray:
    """Ramp from 0 at `signed` = -width to 1 at +width."""
    return np.clip(0.5 + 0.5 * signed / width, 0, 1)
