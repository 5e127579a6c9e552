"""Projects the hand: a mitten seen from above and below, because fingers cannot be flattened well."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy import ndarray as Array
from on_surface import closest_on_faces

OUTLINE_WINDOW, OUTLINE_SMOOTHING = 0.012, 0.008
"""Metres along the hand: the window of the outline's extremes, and its blur. A larger window bridges the gaps between
fingers; more blur makes rows even and loses the tip of the thumb."""
REACH_WINDOW, REACH_SMOOTHING = 0.12, 0.3
"""The same for the fingertips, as shares of the hand's width."""
SLOPE = 0.05
"""Faces whose normal's y is beyond this are back (+) or palm (-); the others are seen from neither side."""


@dataclasses.dataclass(frozen=True)
class Mitten:
    """The smooth outline of a left hand in T-pose (x along the fingers, thumb towards +z), seen along y."""

    wrist: float
    stations: Array
    rear: Array
    front: Array
    """z of the outline's two sides at the x of the stations."""
    shares: Array
    tips: Array
    """x of the fingertips at a share 0 .. 1 of the way from rear to front."""

    @classmethod
    def around(cls, points: Array) -> Mitten:
        """The outline of the hand's vertices."""
        wrist, tip = points[:, 0].min(), points[:, 0].max()
        stations = np.linspace(wrist, tip, 60)
        near = [points[np.abs(points[:, 0] - x) < OUTLINE_WINDOW, 2] for x in stations]
        sigma = OUTLINE_SMOOTHING / (stations[1] - stations[0])
        rear, front = (_blurred(np.array([edge(z) for z in near]), sigma) for edge in (np.min, np.max))
        across = (points[:, 2] - np.interp(points[:, 0], stations, rear)) / np.interp(
            points[:, 0], stations, front - rear
        )
        shares = np.linspace(0, 1, 30)
        reach = np.array([points[np.abs(np.clip(across, 0, 1) - share) < REACH_WINDOW, 0].max() for share in shares])
        return cls(wrist, stations, rear, front, shares, _blurred(reach, REACH_SMOOTHING * 29))

    def at(self, share: Array, along: Array) -> tuple[Array, Array]:
        """x and z at a share of the way from rear to front and a share of the way from wrist to fingertips."""
        x = self.wrist + along * (np.interp(share, self.shares, self.tips) - self.wrist) * 0.985
        rear, front = np.interp(x, self.stations, self.rear), np.interp(x, self.stations, self.front)
        return x, rear + share * (front - rear)


def project_hand(vertices: Array, faces: Array, hand: Array, uv: Array) -> tuple[Array, Array]:
    """Face and barycentric coordinates for chart coordinates uv [n, 2] in the unit square.

    u runs from the thumb's side to the little finger over the back of the hand, then back over the palm; v from the
    fingertips to the wrist. `hand` lists the body's faces of the hand. Points that look down between fingers get the
    closest face.
    """
    normal = np.cross(*(vertices[faces[hand, k]] - vertices[faces[hand, 0]] for k in (1, 2)))
    slope = normal[:, 1] / np.linalg.norm(normal, axis=1)
    u, along = uv[:, 0], 1 - uv[:, 1]
    mitten = Mitten.around(vertices[np.unique(faces[hand])])
    x, z = mitten.at(np.where(u < 0.5, 1 - 2 * u, 2 * u - 1), along)
    face, barycentric = np.zeros(len(uv), dtype=int), np.zeros((len(uv), 3))
    for upward in (True, False):
        chosen = np.flatnonzero((u < 0.5) == upward)
        side = hand[slope > SLOPE] if upward else hand[slope < -SLOPE]
        face[chosen], barycentric[chosen] = _drop(vertices, faces, side, x[chosen], z[chosen], upward)
    return face, barycentric


def _drop(vertices: Array, faces: Array, side: Array, x: Array, z: Array, upward: bool) -> tuple[Array, Array]:
    """The outermost of the faces `side` over each (x, z); otherwise the closest to the height of the nearest face."""
    corners = vertices[faces[side]]
    a, b, c = (corners[:, k][:, [0, 2]] for k in range(3))
    point = np.stack([x, z], -1)[:, None]
    twice_area = _cross(b - a, c - a)
    wb = _cross(point - a, c - a) / twice_area
    wc = _cross(b - a, point - a) / twice_area
    weights = np.stack([1 - wb - wc, wb, wc], -1)
    height = (weights * corners[None, :, :, 1]).sum(-1)
    hit = (weights >= 0).all(-1)
    best = np.where(hit, height if upward else -height, -np.inf).argmax(1)
    index = np.arange(len(x))
    face, barycentric = side[best], weights[index, best]
    missed = np.flatnonzero(~hit.any(1))
    if len(missed):
        centre = corners.mean(1)
        nearest = ((centre[None, :, [0, 2]] - point[missed]) ** 2).sum(-1).argmin(1)
        level = np.stack([x[missed], centre[nearest, 1], z[missed]], -1)
        face[missed], barycentric[missed] = closest_on_faces(vertices, faces, side, level)
    return face, barycentric


def _cross(p: Array, q: Array) -> Array:
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]


def _blurred(values: Array, sigma: float) -> Array:
    """Gaussian blur with repeated ends."""
    reach = int(np.ceil(3 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.convolve(np.pad(values, reach, "edge"), kernel / kernel.sum(), "valid")
