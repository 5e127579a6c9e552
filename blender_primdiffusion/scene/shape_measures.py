"""What a body measures, and bodies of given measures; the backend's `body.measures` is the twin."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .shape_model import ShapeModel
from .shape_names import BETAS, LARGEST_BETA

DENSITY = 985.0
"""kg/m^3 of a living person with air in the lungs."""
MOST_CORRECTIONS = 20
_TOLERANCE = np.array([1e-4, 1e-2])
"""Metres, kilograms."""


class Measures(NamedTuple):
    """Of a bare body at rest."""

    height: float
    """Metres."""
    weight: float
    """Kilograms: the volume within the skin, as heavy as a person."""


def measure(model: ShapeModel, betas: NDArray) -> Measures:
    """Height and weight at these betas [10]."""
    return _measured(model, tuple(np.asarray(betas, np.float64)))


def betas_of_measures(
    model: ShapeModel, betas: NDArray, height: float | None = None, weight: float | None = None
) -> NDArray[np.float64]:
    """The betas [10], moved as little as possible until the body has the given height (m) and weight (kg).

    Newton steps of least length, exact to 0.1 mm and 10 g. Raises ValueError where no body within LARGEST_BETA has
    these measures.
    """
    rows = [row for row, value in enumerate((height, weight)) if value is not None]
    target = np.array([value for value in (height, weight) if value is not None])
    moved = np.array(betas, np.float64)
    for _ in range(MOST_CORRECTIONS if rows else 0):
        missing = target - np.array(measure(model, moved))[rows]
        if (np.abs(missing) < _TOLERANCE[rows]).all():
            break
        slope = _slope(model, moved)[rows]
        moved = moved + slope.T @ np.linalg.solve(slope @ slope.T, missing)
        if not np.abs(moved).max() <= LARGEST_BETA:
            break
    else:
        moved = moved if not rows else moved * np.inf
    if rows and not np.abs(moved).max() <= LARGEST_BETA:
        names = (("a height of {:.2f} m", height), ("a weight of {:.0f} kg", weight))
        asked = " with ".join(text.format(value) for text, value in names if value is not None)
        raise ValueError(f"no body of this model has {asked}: ask for something more usual")
    return moved


@functools.lru_cache(maxsize=64)
def _measured(model: ShapeModel, betas: tuple[float, ...]) -> Measures:
    vertices = model.surface(np.array(betas))
    upright = vertices[:, 1]
    a, b, c = (vertices[model.faces[:, corner]] for corner in range(3))
    volume = float(np.einsum("fx,fx->", a, np.cross(b, c))) / 6  # signed tetrahedra to the origin
    return Measures(float(upright.max() - upright.min()), abs(volume) * DENSITY)


def _slope(model: ShapeModel, betas: NDArray) -> NDArray[np.float64]:
    """Derivatives of height and weight by each beta [2, 10]."""
    vertices = model.surface(betas)
    top, sole = np.argmax(vertices[:, 1]), np.argmin(vertices[:, 1])
    a, b, c = (vertices[model.faces[:, corner]] for corner in range(3))
    pull = np.zeros_like(vertices)  # of the volume, times 6, by each vertex
    for corner, cross in enumerate((np.cross(b, c), np.cross(c, a), np.cross(a, b))):
        for axis in range(3):
            pull[:, axis] += np.bincount(model.faces[:, corner], cross[:, axis], len(vertices))
    sign = np.sign(np.einsum("fx,fx->", a, np.cross(b, c)))
    volume = pull.reshape(-1) @ model.shape_basis.reshape(-1, BETAS) / 6
    return np.stack([model.shape_basis[top, 1] - model.shape_basis[sole, 1], sign * DENSITY * volume])
