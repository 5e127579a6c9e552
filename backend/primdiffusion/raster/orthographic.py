"""Orthographic views: pictures by parallel rays, used to find what of a mesh can be seen."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True, eq=False)
class OrthographicView:
    """Parallel rays along the third row of `world_to_view`; x right, y down, as in an OpenCV camera."""

    world_to_view: Float[np.ndarray, "3 4"]
    """[R | t], metres; the view's origin is the outer corner of pixel (0, 0)."""
    pixel_size: float
    """Side of a pixel, metres."""
    width: int
    height: int

    @property
    def direction(self) -> Float[np.ndarray, "3"]:
        """Where the rays go."""
        return self.world_to_view[2, :3]


def view_along(
    direction: tuple[float, float, float], bounds: Float[np.ndarray, "2 3"], pixel_size: float
) -> OrthographicView:
    """The view along `direction` that just holds the box `bounds` and starts in front of it; y of the world is up.

    Raises:
        ValueError: `direction` is zero or `pixel_size` is not positive.
    """
    forward = np.asarray(direction, np.float64)
    length = float(np.linalg.norm(forward))
    if length == 0 or pixel_size <= 0:
        raise ValueError(
            f"No view along {direction} with pixels of {pixel_size} m: give a direction and a positive pixel size."
        )
    forward = forward / length
    up = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.999 else np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    corners = np.stack(np.meshgrid(*np.asarray(bounds, np.float64).T, indexing="ij"), -1).reshape(8, 3) @ rotation.T
    low, high = corners.min(0) - pixel_size, corners.max(0) + pixel_size
    width, height = (math.ceil((high[axis] - low[axis]) / pixel_size) for axis in (0, 1))
    return OrthographicView(np.concatenate([rotation, -low[:, None]], axis=1), pixel_size, width, height)
