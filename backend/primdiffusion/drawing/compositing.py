"""People over solids over a background, pixel by pixel.

Solids are seen through FINER x FINER points of each pixel, so that their outlines are smooth; people through its
centre. Where one surface fills the pixel the marcher's ray has ended at it and what people leave shows the surface. At
an outline the ray has passed on: each of the points then shows its solid alone where that is nearer than the people's
expected depth, and the people over it where it is not.
"""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from primdiffusion.drawing.scene import NOTHING, Picture
from primdiffusion.geometry.camera import Camera
from primdiffusion.raster.nearest_triangle import nearest_triangles
from primdiffusion.render.solids import Layer, Solids, shade_solids

FINER = 2
"""Points of a pixel along each side at which solids are looked for."""
STEEPEST = 6.0
"""A pixel shows one surface where depths within it differ by less than this many times the pixel's width there (a slope
of 80 degrees), or all belong to one triangle. Measured in pixels, so that it holds for far and narrow views as well."""


@dataclasses.dataclass(frozen=True, eq=False)
class Backdrop:
    """What stands among people."""

    solids: Layer
    """At FINER times the picture's size."""
    hole: Bool[ndarray, "fh fw"]
    """Where a holdout is seen, at that size."""
    end: Float32[ndarray, "h w"]
    """Depth along the optical axis at which a pixel's ray ends; inf where a part of it goes on."""
    outline: Bool[ndarray, "h w"]
    """Whether a pixel shows more than one surface, or one in a part of it only."""


def backdrop(solids: Solids, camera: Camera, clip: tuple[float, float]) -> Backdrop:
    """The solids as `camera` sees them between the depths `clip`."""
    intrinsics = camera.intrinsics.clone()
    intrinsics[:2] *= FINER
    size = {"width": camera.width * FINER, "height": camera.height * FINER}
    finer = dataclasses.replace(camera, intrinsics=intrinsics, **size)
    nearest = nearest_triangles(solids.corners, finer, clip)
    hole = (nearest.triangle >= 0) & solids.holdout[nearest.triangle] if solids.holdout.any() else None
    end = np.empty((camera.height, camera.width), np.float32)
    outline = np.empty((camera.height, camera.width), np.bool_)
    _find_ends(nearest.triangle, nearest.depth, 1 / float(camera.intrinsics[0, 0]), end, outline)
    shaded = shade_solids(solids, nearest, finer)
    return Backdrop(shaded, np.zeros(shaded.alpha.shape, np.bool_) if hole is None else hole, end, outline)


def over_background(picture: Picture, people: Layer, background: tuple[float, float, float] | None) -> None:
    """Writes people without solids into `picture`."""
    wall = np.float32(background is not None)
    colour = np.array(background or (0, 0, 0), np.float32)
    _compose_alone(people.rgb, people.alpha, people.depth, wall, colour, picture.combined, picture.depth)


def over_solids(
    picture: Picture,
    people: Layer,
    expected: Float32[ndarray, "h w"],
    behind: Backdrop,
    background: tuple[float, float, float] | None,
) -> None:
    """Writes people among solids into `picture`; `expected` is their expected depth, inf where nobody is."""
    wall = np.float32(background is not None)
    colour = np.array(background or (0, 0, 0), np.float32)
    solids = (behind.solids.rgb, behind.solids.alpha, behind.solids.depth, behind.hole, behind.outline)
    front = (people.rgb, people.alpha, people.depth, expected)
    _compose(*front, *solids, wall, colour, picture.combined, picture.depth)


@numba.njit(cache=True, nogil=True)
def _find_ends(triangle, depth, pixel, end, outline):
    for row in range(end.shape[0]):
        for column in range(end.shape[1]):
            low, high, inverse, one_triangle = np.inf, 0.0, 0.0, True
            for i in range(FINER * FINER):
                y, x = row * FINER + i // FINER, column * FINER + i % FINER
                low, high, inverse = min(low, depth[y, x]), max(high, depth[y, x]), inverse + 1.0 / depth[y, x]
                one_triangle = one_triangle and triangle[y, x] == triangle[row * FINER, column * FINER]
            outline[row, column] = not one_triangle and not high - low <= STEEPEST * pixel * low
            # On a plane the inverse of the depth is linear in the picture: this mean is the depth at the centre.
            end[row, column] = high if outline[row, column] or inverse == 0.0 else FINER * FINER / inverse


@numba.njit(cache=True, nogil=True)
def _compose_alone(rgb, alpha, hit, wall, colour, combined, depth):
    for row in range(alpha.shape[0]):
        for column in range(alpha.shape[1]):
            through = (np.float32(1) - alpha[row, column]) * wall
            for channel in range(3):
                combined[row, column, channel] = rgb[row, column, channel] + through * colour[channel]
            combined[row, column, 3] = alpha[row, column] + through
            depth[row, column] = min(hit[row, column], NOTHING)


@numba.njit(cache=True, nogil=True)
def _compose(
    rgb, alpha, hit, expected, solid_rgb, solid_alpha, solid_depth, hole, outline, wall, colour, combined, depth
):
    share = np.float32(1 / (FINER * FINER))
    light = np.empty(4, np.float32)
    for row in range(alpha.shape[0]):
        for column in range(alpha.shape[1]):
            light[:] = 0
            nearest, second, inverse = np.inf, np.inf, 0.0
            for i in range(FINER * FINER):
                y, x = row * FINER + i // FINER, column * FINER + i % FINER
                z = solid_depth[y, x]  # of a holdout: inf
                hidden = outline[row, column] and z < expected[row, column]
                through = np.float32(1) if hidden else np.float32(1) - alpha[row, column]
                free = (np.float32(0) if hole[y, x] else np.float32(1) - solid_alpha[y, x]) * wall
                for channel in range(3):
                    person = np.float32(0) if hidden else rgb[row, column, channel]
                    light[channel] += person + through * (solid_rgb[y, x, channel] + free * colour[channel])
                light[3] += np.float32(1) - through + through * (solid_alpha[y, x] + free)
                nearest, second, inverse = min(nearest, z), min(second, max(nearest, z)), inverse + 1.0 / z
            for channel in range(4):
                combined[row, column, channel] = light[channel] * share
            # Where half of the points are covered: the depth at which opacity reaches one half, as for people.
            solid = second if outline[row, column] or inverse == 0.0 else 1.0 / (share * inverse)
            depth[row, column] = min(hit[row, column], solid, NOTHING)
