"""Which of two colours cloth has where: broad patterns laid over a person by their rest position.

Each takes rest positions of the average body (metres, arms level) and gives the share of the second colour, 0 to 1.
Phases are the same for everybody and nothing is finer than a few centimetres: primitives a voxel of which is a
centimetre wide cannot show more, and a network could not learn random phases.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

Pattern = Callable[[Float[np.ndarray, "*b 3"]], Float[np.ndarray, "*b"]]

SHOULDER_X, SHOULDER_Y, EDGE = 0.2, 0.254, 0.003
"""Where sleeves begin, the height of the arms, and the half width of soft edges, metres."""


def hanging_height(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Height with the arms let down: what cloth bands follow, metres."""
    along_arm = np.abs(position[..., 0]) - SHOULDER_X
    return np.where(along_arm > 0, np.minimum(position[..., 1], SHOULDER_Y) - along_arm, position[..., 1])


def bands(position: Float[np.ndarray, "*b 3"], period: float = 0.14) -> Float[np.ndarray, "*b"]:
    """Broad stripes around body and sleeves."""
    return _soft(_wave(hanging_height(position) / period) - 0.25, EDGE / period)


def plaid(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Crossing bands: full where two cross, half where one runs alone."""
    across = np.where(np.abs(position[..., 0]) > SHOULDER_X, position[..., 2], position[..., 0])
    along = _soft(_wave(across / 0.12) - 0.25, EDGE / 0.12)
    return 0.5 * (bands(position, 0.12) + along)


def dots(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Large dots in staggered rows, seen from the front."""
    row = np.floor(position[..., 1] / 0.08)
    x = position[..., 0] / 0.1 + 0.5 * (row % 2)
    distance = np.hypot((x - np.rint(x)) * 0.1, position[..., 1] - (row + 0.5) * 0.08)
    return _soft(0.026 - distance, EDGE)


def sleeves(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Sleeves of the second colour."""
    # Hips, which can be as wide, are not sleeves.
    raised = position[..., 1] > SHOULDER_Y - 0.25
    return np.where(raised, _soft(np.abs(position[..., 0]) - SHOULDER_X + 0.02, EDGE), 0)


def yoke(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Shoulders and arms of the second colour, down to the chest."""
    return _soft(position[..., 1] - (SHOULDER_Y - 0.1), EDGE)


def chest_band(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """One broad band around the chest and both upper arms."""
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
    """0 where `signed` is below -width, 1 where above, linear between."""
    return np.clip(0.5 + 0.5 * signed / width, 0, 1)
