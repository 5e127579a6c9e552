"""Camera rigs of captures, rings, spheres and hemispheres around a human; places of humans who stand together there.

World: metres, y up, the human faces +z. OpenCV cameras: x right, y down, z forward, pixel centres at +0.5.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from .poses.rotation import ROTATION, first_improper
from .schema import Checked, Length, Range, Slider

Arrangement = Literal["rings", "sphere", "hemisphere"]
_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
_LOWEST = -0.2
"""Sine of the lowest elevation of a hemisphere, slightly below the horizon."""


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """One camera: `x_pixel ~ intrinsics @ (rotation @ x_world + translation)`.

    Raises ValueError for a matrix that is not a rotation, such as a reflection.
    """

    intrinsics: NDArray[np.float64]
    """[3, 3], pixels."""
    rotation: NDArray[np.float64]
    """[3, 3], world to camera."""
    translation: NDArray[np.float64]
    """[3], metres."""
    width: int
    height: int

    def __post_init__(self) -> None:
        if first_improper(self.rotation[None, None]) is not None:
            raise ValueError(f"R is not {ROTATION}")

    @property
    def position(self) -> NDArray[np.float64]:
        """The centre of projection [3], metres."""
        return -self.rotation.T @ self.translation

    def project(self, points: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixels [..., 2] and depth along the optical axis [...] of points [..., 3]; behind the camera it is <= 0."""
        in_camera = np.asarray(points, np.float64) @ self.rotation.T + self.translation
        homogeneous = in_camera @ self.intrinsics.T
        return homogeneous[..., :2] / homogeneous[..., 2:], in_camera[..., 2]


@dataclasses.dataclass(frozen=True)
class Rig(Checked):
    """Equal cameras on a sphere around a target, which is at the centre of their images."""

    arrangement: Arrangement = "rings"
    """Arrangement of the cameras."""
    count: Annotated[int, Range(1), Slider(1, 200)] = 36
    """Number of views of each pose."""
    elevations: Annotated[tuple[Annotated[float, Range(-89, 89)], ...], Length(1)] = (-10.0, 15.0, 40.0)
    """Elevation of each ring, degrees above the horizon; cameras are distributed evenly to the rings."""
    vertical_fov: Annotated[float, Range(1, 150)] = 30.0
    """Vertical field of view, degrees."""
    width: Annotated[int, Range(1, 16384)] = 512
    """Width of the images, pixels."""
    height: Annotated[int, Range(1, 16384)] = 512
    """Height of the images, pixels."""
    margin: Annotated[float, Range(0.1, 100)] = 1.05
    """Size of the view relative to the bounding sphere of the humans."""

    def views(self, target: NDArray, radius: float) -> list[View]:
        """Return the cameras around `target` [3], at a distance that shows all of a sphere of `radius` metres.

        Raises ValueError if target or radius are not finite, or the radius is not positive.
        """
        target = np.asarray(target, np.float64)
        if not (np.isfinite(target).all() and np.isfinite(radius) and radius > 0):
            raise ValueError(f"a rig about {target.tolist()} with radius {radius}: the bounding sphere must be finite")
        narrow = min(1.0, self.width / self.height) * math.tan(math.radians(self.vertical_fov) / 2)
        distance = self.margin * radius / math.sin(math.atan(narrow))
        return [
            look_at(target + distance * direction, target, math.radians(self.vertical_fov), self.width, self.height)
            for direction in self.directions()
        ]

    def directions(self) -> NDArray[np.float64]:
        """Unit vectors [count, 3] from the target to the cameras; the first of a ring is in front of the face."""
        if self.arrangement == "rings":
            return _rings(self.count, self.elevations)
        lowest = -1.0 if self.arrangement == "sphere" else _LOWEST
        height = lowest + (1 - lowest) * (np.arange(self.count) + 0.5) / self.count
        return _on_sphere(np.arange(self.count) * _GOLDEN_ANGLE, height)


def look_at(position: NDArray, target: NDArray, vertical_fov: float, width: int, height: int) -> View:
    """A camera at `position` with `target` at the centre of its image; `vertical_fov` in radians, square pixels."""
    forward = np.asarray(target, np.float64) - position
    forward = forward / np.linalg.norm(forward)
    up = (0.0, 1.0, 0.0) if abs(forward[1]) < 1 - 1e-9 else (0.0, 0.0, math.copysign(1.0, -forward[1]))
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal = height / (2 * math.tan(vertical_fov / 2))
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return View(intrinsics, rotation, -rotation @ position, width, height)


def bounding_sphere(points: NDArray) -> tuple[NDArray[np.float64], float]:
    """Centre [3] of the bounding box of points [..., 3], and the radius around it that contains them, metres."""
    points = np.asarray(points, np.float64).reshape(-1, 3)
    centre = (points.min(0) + points.max(0)) / 2
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def _rings(count: int, elevations: tuple[float, ...]) -> NDArray[np.float64]:
    rings = len(elevations)
    members = [len(range(ring, count, rings)) for ring in range(rings)]
    azimuth = np.concatenate([2 * math.pi * np.arange(n) / max(n, 1) for n in members])
    height = np.repeat(np.sin(np.radians(elevations)), members)
    return _on_sphere(azimuth, height)


def _on_sphere(azimuth: NDArray, height: NDArray) -> NDArray[np.float64]:
    """Azimuth 0 is in front of the face (+z), a quarter turn at the human's left (+x)."""
    across = np.sqrt(np.maximum(1 - height**2, 0))
    return np.stack([across * np.sin(azimuth), height, across * np.cos(azimuth)], -1).astype(np.float64)


MOST_TOGETHER = 8
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
