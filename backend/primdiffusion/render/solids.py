"""Opaque things beside people: triangles of one colour each, lit just enough to be read as shapes."""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from primdiffusion.geometry.camera import Camera
from primdiffusion.raster.z_buffer import NearestTriangle

SKY = 0.45
"""Light from all above: SKY * (1 + n_up) / 2."""
HEADLIGHT = 0.55
"""Light from where the viewer stands: HEADLIGHT * |n . ray|. With the sky's no more than 1: colours are never
brighter than they were given."""


class UnusableSolids(ValueError):
    """Triangles that cannot be drawn: of wrong shapes, or not finite."""


@dataclasses.dataclass(frozen=True, eq=False)
class Solids:
    """Opaque triangles in the world, seen from both sides."""

    corners: Float32[ndarray, "f 3 3"]
    """Metres."""
    colour: Float32[ndarray, "f 3"]
    """Linear RGB."""
    holdout: Bool[ndarray, "f"]
    """Whether it cuts a hole into the picture: it hides what is behind it and is itself not seen."""

    def __post_init__(self) -> None:
        """Refuse arrays that do not belong together, and NaN."""
        count = len(self.corners)
        for name, shape in (("corners", (count, 3, 3)), ("colour", (count, 3)), ("holdout", (count,))):
            value = getattr(self, name)
            if value.shape != shape:
                raise UnusableSolids(f"{name} of the solids has shape {value.shape}; it must be {shape}")
            if not np.isfinite(value).all():
                raise UnusableSolids(f"{name} of the solids holds NaN or infinite values: repair the meshes")


@dataclasses.dataclass(frozen=True, eq=False)
class Layer:
    """A picture that others are put over or behind."""

    rgb: Float32[ndarray, "h w 3"]
    """Linear, premultiplied by alpha."""
    alpha: Float32[ndarray, "h w"]
    depth: Float32[ndarray, "h w"]
    """Metres along the optical axis to what is seen; inf where there is nothing."""

    @classmethod
    def nothing(cls, camera: Camera) -> Layer:
        """An empty picture; read only."""
        size = (camera.height, camera.width)
        zero, infinity = np.float32(0), np.float32(np.inf)
        return cls(np.broadcast_to(zero, (*size, 3)), np.broadcast_to(zero, size), np.broadcast_to(infinity, size))


def shade_solids(solids: Solids, nearest: NearestTriangle, camera: Camera) -> Layer:
    """The solids lit by a sky and a headlight, flat over a triangle; empty at holdouts, whose depth is inf as well.

    colour * (SKY (1 + n_up) / 2 + HEADLIGHT |n . ray|), n the normal on the viewer's side. Pixels are wholly covered
    or not at all.
    """
    nothing = Layer.nothing(camera)
    layer = Layer(nothing.rgb.copy(), nothing.alpha.copy(), nothing.depth.copy())
    _, direction = eye_of(camera)
    seen = (nearest.triangle, nearest.depth, direction)
    _shade(solids.corners, solids.colour, solids.holdout, *seen, layer.rgb, layer.alpha, layer.depth)
    return layer


def eye_of(camera: Camera) -> tuple[ndarray, ndarray]:
    """The camera's place [3], and [3, 3] that takes (u, v, 1) to the direction in the world with depth 1."""
    k = camera.intrinsics.detach().cpu().double().numpy()
    view = camera.world_to_camera.detach().cpu().double().numpy()
    return -view[:, :3].T @ view[:, 3], view[:, :3].T @ np.linalg.inv(k)


@numba.njit(cache=True, nogil=True)
def _shade(corners, colour, holdout, triangle, distance, direction, rgb, alpha, depth):
    normal, ray = np.empty(3), np.empty(3)
    for row in range(triangle.shape[0]):
        for column in range(triangle.shape[1]):
            f = triangle[row, column]
            if f < 0 or holdout[f]:
                continue
            for axis in range(3):
                ray[axis] = direction[axis, 0] * (column + 0.5) + direction[axis, 1] * (row + 0.5) + direction[axis, 2]
                i, j = (axis + 1) % 3, (axis + 2) % 3
                normal[axis] = (corners[f, 1, i] - corners[f, 0, i]) * (corners[f, 2, j] - corners[f, 0, j]) - (
                    corners[f, 1, j] - corners[f, 0, j]
                ) * (corners[f, 2, i] - corners[f, 0, i])
            length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
            along = normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]
            up = -normal[1] if along > 0 else normal[1]
            facing = abs(along) / np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
            light = (0.5 * SKY * (length + up) + HEADLIGHT * facing) / max(length, 1e-30)
            for channel in range(3):
                rgb[row, column, channel] = colour[f, channel] * light
            alpha[row, column] = 1.0
            depth[row, column] = distance[row, column]
