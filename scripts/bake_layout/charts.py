"""The ten charts: their places on the grid, and how each region of the half body is flattened to its rectangle."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from cutting import cheapest_path, cut_along, outline, runs
from half_body import Sheet, smoothed
from numpy import ndarray as Array
from rectangle import Disc, Flat, flatten
from regions import REGIONS


@dataclasses.dataclass(frozen=True)
class Place:
    """A rectangle of whole cells on the half grid (column 0 is the person's midline)."""

    width: int
    """Cells across the chart before turning."""
    height: int
    column: int
    row: int
    quarter_turns: int
    """Counter-clockwise, about the rectangle's middle."""

    @property
    def extent(self) -> tuple[int, int]:
        """Columns and rows on the grid, after turning."""
        return (self.width, self.height) if self.quarter_turns % 2 == 0 else (self.height, self.width)

    def to_grid(self, uv: Array) -> Array:
        """Chart coordinates (cells) to half-grid coordinates (cells)."""
        s, t = uv[..., 0], uv[..., 1]
        turned = {
            0: (s, t),
            1: (self.height - t, s),
            2: (self.width - s, self.height - t),
        }[self.quarter_turns]
        return np.stack(turned, -1) + np.array([self.column, self.row])

    def from_grid(self, point: Array) -> Array:
        """Half-grid coordinates to chart coordinates, the inverse of to_grid."""
        x, y = point[..., 0] - self.column, point[..., 1] - self.row
        turned = {
            0: (x, y),
            1: (y, self.height - x),
            2: (self.width - x, self.height - y),
        }[self.quarter_turns]
        return np.stack(turned, -1)


PLACES = {
    "torso": Place(10, 13, 0, 8, 0),
    "head": Place(9, 11, 0, 21, 0),
    "arm": Place(7, 11, 9, 21, 0),
    "hand": Place(6, 6, 10, 15, 0),
    "leg": Place(8, 16, 0, 0, 1),
    "foot": Place(6, 7, 10, 8, 2),
}
SMOOTHING = {"torso": 0.012, "head": 0.020, "arm": 0.012, "leg": 0.012, "foot": 0.005}
"""Smoothing radius in metres before a region is flattened: the face's features vanish, the toes remain separate."""
EMPHASIS = {"torso": 1.0, "head": 0.0, "arm": 1.0, "leg": 1.0, "foot": 0.0}
"""See rectangle.flatten. The head is a near-hemisphere with equal cells either way."""

NECK_ON_SIDES = 1.0
"""Share of the half neck's arc, front and back, that is on the sides of the torso's rectangle instead of the top."""


def lay_out(sheet: Sheet, region: Array) -> dict[str, Flat]:
    """Every region except the hand on its rectangle (the hand is projected, see hand.py)."""
    regions = _Regions(sheet, region)
    return {
        "torso": _torso(regions),
        "head": _head(regions),
        "arm": _arm(regions),
        "leg": _leg(regions),
        "foot": _foot(regions),
    }


class _Regions:
    def __init__(self, sheet: Sheet, region: Array) -> None:
        self.sheet, self.region, self.points = sheet, region, sheet.points
        self.copies = {radius: smoothed(sheet, radius) for radius in sorted(set(SMOOTHING.values()))}

    def faces(self, name: str) -> Array:
        return self.sheet.faces[self.region == REGIONS.index(name)]

    def vertices(self, name: str) -> Array:
        return np.unique(self.faces(name))

    def ring(self, one: str, other: str) -> Array:
        return np.intersect1d(self.vertices(one), self.vertices(other))

    def lowest(self, candidates: Array, score: Array) -> int:
        return int(candidates[score.argmin()])

    def open(self, name: str, path: Sequence[int]) -> tuple[Disc, list[int], Array]:
        """The region cut along the path: a disc, its outline, and the sheet's vertex for each vertex of the disc."""
        faces, origin = cut_along(self.faces(name), path)
        parent = self.sheet.parent[self.region == REGIONS.index(name)]
        disc = Disc(self.points[origin], self.copies[SMOOTHING[name]][origin], faces, parent)
        return disc, outline(faces), origin

    def flat(
        self, name: str, disc: Disc, loop: list[int], corners: Sequence[int], seams: Sequence[tuple[int, int]] = ()
    ) -> Flat:
        place = PLACES[name]
        return flatten(disc, loop, corners, place.width, place.height, seams, EMPHASIS[name])


def _torso(regions: _Regions) -> Flat:
    """Front midline left, back midline right, groin below; neck, shoulder seam and armhole above."""
    p, midline = regions.points, regions.sheet.midline
    neck, armhole = regions.ring("torso", "head"), regions.ring("torso", "arm")
    top = regions.lowest(armhole, 0.6 * np.abs(p[armhole, 2] - 0.01) - p[armhole, 1])
    side_of_neck = neck[~midline[neck]]
    start = regions.lowest(side_of_neck, np.linalg.norm(p[side_of_neck] - (0.098, p[top, 1], 0.0), axis=1))
    path = cheapest_path(p, regions.faces("torso"), start, top, avoid=[*neck, *armhole])
    disc, loop, origin = regions.open("torso", path)
    front, back = sorted(runs(loop, midline[origin]), key=lambda run: -disc.points[run, 2].mean())
    # The rectangle's upper corners are on the neck, so that its sides include the neck's arc: the upper side, with the
    # armhole, is far longer than any other row, and its cells would be 8 cm wide.
    forward = loop[loop.index(back[-1]) :] + loop[: loop.index(back[-1])]
    upper = forward[: forward.index(front[0]) + 1]
    at_seam = [i for i, v in enumerate(upper) if origin[v] == start]
    right = upper[round(at_seam[0] * NECK_ON_SIDES)]
    left = upper[round(len(upper) - 1 - (len(upper) - 1 - at_seam[1]) * NECK_ON_SIDES)]
    return regions.flat("torso", disc, loop, (front[-1], back[0], right, left))


def _head(regions: _Regions) -> Flat:
    """Half a head: the neck below, the face's midline left, the back's right, the crown above."""
    disc, loop, origin = regions.open("head", ())
    (run,) = runs(loop, regions.sheet.midline[origin])  # up the back of the neck, over the crown, down the face
    points = disc.points[run]
    crown = points[:, 1].max()
    behind = [i for i in range(len(run)) if points[i, 2] < 0.05]
    before = [i for i in range(len(run)) if points[i, 2] >= 0.05 and points[i, 1] > crown - 0.09]
    back_corner = min(behind, key=lambda i: abs(points[i, 1] - (crown - 0.048)))
    front_corner = min(before, key=lambda i: abs(points[i, 1] - (crown - 0.031)))
    return regions.flat("head", disc, loop, (run[-1], run[0], run[back_corner], run[front_corner]))


def _arm(regions: _Regions) -> Flat:
    """A tube cut along its underside: the wrist below, the armhole above."""
    p = regions.points
    armhole, wrist = regions.ring("arm", "torso"), regions.ring("arm", "hand")
    pit = regions.lowest(armhole, p[armhole, 1] + 0.6 * np.abs(p[armhole, 2] - 0.03))
    heel = regions.lowest(wrist, p[wrist, 1] + 0.6 * np.abs(p[wrist, 2] - p[wrist, 2].mean()))

    def underside(middle: Array) -> Array:
        return 1 + 30 * np.abs(middle[:, 2] - 0.035) + 10 * np.maximum(middle[:, 1] - p[heel, 1], 0)

    path = cheapest_path(p, regions.faces("arm"), pit, heel, underside, avoid=[*armhole, *wrist])
    return _tube(regions, "arm", path, upper=pit, lower=heel)


def _leg(regions: _Regions) -> Flat:
    """A tube cut along its inside: the ankle below, the hip above."""
    p = regions.points
    leg = regions.vertices("leg")
    crotch, ankle = leg[regions.sheet.midline[leg]], regions.ring("leg", "foot")
    upper = regions.lowest(crotch, np.abs(p[crotch, 2] - np.median(p[crotch, 2])))
    lower = inner_ankle(regions)

    def inside(middle: Array) -> Array:
        return 1 + 20 * np.abs(middle[:, 2] - 0.015)

    path = cheapest_path(p, regions.faces("leg"), upper, lower, inside, avoid=[*ankle, *crotch])
    return _tube(regions, "leg", path, upper=upper, lower=lower)


def inner_ankle(regions: _Regions) -> int:
    """The vertex where the seams of leg and foot meet."""
    p, ring = regions.points, regions.ring("leg", "foot")
    return regions.lowest(ring, p[ring, 0] + 0.6 * np.abs(p[ring, 2] - p[ring, 2].mean()))


def _foot(regions: _Regions) -> Flat:
    """Cut along its inner edge and across the tips of the toes: the ankle above, the toes below."""
    p, ankle = regions.points, regions.ring("foot", "leg")
    foot = regions.vertices("foot")
    sole = p[foot, 1].min()
    x, y, z = (p[foot] - (p[ankle, 0].mean(), sole, 0)).T
    big_toe = regions.lowest(foot, -(z - x) + 0.8 * np.abs(y - 0.02))
    small_toe = regions.lowest(foot, -(0.9 * z + 1.6 * x) + 0.8 * np.abs(y - 0.016))
    start = inner_ankle(regions)
    toe_line, tip = sole + 0.02, p[big_toe, 2]

    def inner_edge(middle: Array) -> Array:
        return 1 + 40 * np.abs(middle[:, 1] - toe_line) * (middle[:, 2] > 0.05)

    def toe_tips(middle: Array) -> Array:
        behind_tips = tip - 0.025 - middle[:, 2] - 0.3 * (middle[:, 0] - p[ankle, 0].mean())
        return 1 + 40 * np.abs(middle[:, 1] - toe_line) + 15 * np.maximum(behind_tips, 0)

    faces = regions.faces("foot")
    path = cheapest_path(p, faces, start, big_toe, inner_edge, avoid=ankle)
    path += cheapest_path(p, faces, big_toe, small_toe, toe_tips, avoid=[*ankle, *path[:-1]])[1:]
    return _tube(regions, "foot", path, upper=start, lower=big_toe, tied=False)


def _tube(regions: _Regions, name: str, path: list[int], upper: int, lower: int, tied: bool = True) -> Flat:
    """A region cut along the path; the two sides of the cut become the rectangle's left and right, lower to upper."""
    disc, loop, origin = regions.open(name, path)
    copies = {v: [w for w in loop if origin[w] == v] for v in path}
    turned = loop[loop.index(copies[upper][0]) :] + loop[: loop.index(copies[upper][0])]
    first, second = copies[upper]
    # Counter-clockwise the loop runs: bottom left, bottom right, up the cut, top right, top left, down the cut.
    after_first = turned[: turned.index(second)]
    top_left, top_right = (first, second) if copies[lower][0] in after_first else (second, first)
    turned = loop[loop.index(top_left) :] + loop[: loop.index(top_left)]
    bottom_left, bottom_right = sorted(copies[lower], key=turned.index)
    seams = [(a, b) for a, b in (copies[v] for v in path[1 : path.index(lower)])] if tied else []
    return regions.flat(name, disc, loop, (bottom_left, bottom_right, top_right, top_left), seams)
