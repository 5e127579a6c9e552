"""Places of humans that stand together on a floor, in front of the same cameras."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

MOST = 8
"""Humans in a group."""
GAP = 0.05
"""Metres at least between the circles on the floor around two humans."""
WIDENING = 0.05
"""Metres by which the disc that a place is drawn from grows whenever a place is not free."""


def places(radii: NDArray, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw centres [n, 2] of circles of radii [n] that are at least GAP apart, metres; the first is in the middle."""
    found = np.zeros((len(radii), 2))
    for number, radius in enumerate(radii):
        reach = 0.0
        while number:
            angle, distance = rng.uniform(0, 2 * math.pi), reach * math.sqrt(rng.uniform())
            found[number] = distance * math.cos(angle), distance * math.sin(angle)
            apart = np.linalg.norm(found[:number] - found[number], axis=1)
            if (apart >= radii[:number] + radius + GAP).all():
                break
            reach += WIDENING
    return found


def first_frames(humans: int, frames: int) -> list[int]:
    """The pose that each human of a group begins with, the others following in turn."""
    return [number * frames // humans for number in range(humans)]


def extent(points: NDArray, pelvis: NDArray) -> tuple[float, float, float]:
    """Largest distance of points [n, 3] from the vertical through the pelvis [3], lowest and highest point, metres."""
    across = points[:, [0, 2]] - pelvis[[0, 2]]
    return float(np.linalg.norm(across, axis=1).max()), float(points[:, 1].min()), float(points[:, 1].max())


def stand_together(
    pelvis: NDArray, extents: NDArray, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw places on the floor y = 0 so that circles around humans do not touch, in every pose anew.

    Args:
        pelvis: joints [n, F, 3] of the humans where they are, metres.
        extents: `extent` [n, F, 3] there.
        rng: the same for all humans of the group.

    Returns:
        The translations [n, F, 3] to their places, and the corners [m, 3] of boxes around all of them there.
    """
    radii, frames = extents[..., 0], extents.shape[1]
    at = np.stack([places(radii[:, frame], rng) for frame in range(frames)], axis=1)
    moves = np.stack([at[..., 0] - pelvis[..., 0], -extents[..., 1], at[..., 1] - pelvis[..., 2]], axis=-1)
    corners = [
        [at[n, frame, 0] + x * radii[n, frame], y, at[n, frame, 1] + z * radii[n, frame]]
        for n in range(len(radii))
        for frame in range(frames)
        for y in (0, extents[n, frame, 2] - extents[n, frame, 1])
        for x, z in ((1, 1), (1, -1), (-1, 1), (-1, -1))
    ]
    return moves, np.array(corners)
