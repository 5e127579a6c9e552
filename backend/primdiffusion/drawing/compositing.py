"""Composite humans over solids over a background, pixel by pixel.

Solids are antialiased with FINER x FINER samples per pixel; humans are sampled once, at the pixel's centre. If one
surface covers the pixel, the marcher's ray ends at that surface and the remaining transmittance shows it. At an outline
the ray does not end: each sample then shows its solid alone if that is nearer than the humans' expected depth, and the
humans over the solid otherwise.
"""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import Image
from primdiffusion.raster.z_buffer import nearest_triangles
from primdiffusion.render.solids import Solids, shade_solids

NOTHING = 1e10
"""Depth of the background in drawn images, metres, as in Blender's Depth pass."""
FINER = 2
"""Samples per pixel along each axis for solids."""
STEEPEST = 6.0
"""A pixel shows a single surface if its samples hit one triangle, or if their depths differ by less than this many
pixel widths at that depth (a slope of 80 degrees). In pixels, so that it also holds for distant and narrow views."""


@dataclasses.dataclass(frozen=True, eq=False)
class Backdrop:
    """The rasterised solids of an image."""

    solids: Image
    """At FINER times the image resolution."""
    hole: Bool[ndarray, "fh fw"]
    """Samples that hit a holdout, at the same resolution."""
    end: Float32[ndarray, "h w"]
    """Depth along the optical axis at which the pixel's ray ends; inf if any sample misses the solids."""
    outline: Bool[ndarray, "h w"]
    """Pixels that show more than one surface, or are partly covered."""


def backdrop(solids: Solids, camera: Camera, clip: tuple[float, float]) -> Backdrop:
    """Rasterise the solids as seen by `camera` between the depths `clip`."""
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


def over_background(picture: Image, people: Image, background: tuple[float, float, float] | None) -> None:
    """Write humans over the background into `picture`."""
    wall = np.float32(background is not None)
    colour = np.array(background or (0, 0, 0), np.float32)
    _compose_alone(people.rgb, people.alpha, people.depth, wall, colour, picture.rgb, picture.alpha, picture.depth)


def over_solids(
    picture: Image,
    people: Image,
    expected: Float32[ndarray, "h w"],
    behind: Backdrop,
    background: tuple[float, float, float] | None,
) -> None:
    """Write humans, solids and background into `picture`; `expected` is the humans' expected depth, inf if none."""
    wall = np.float32(background is not None)
    colour = np.array(background or (0, 0, 0), np.float32)
    solids = (behind.solids.rgb, behind.solids.alpha, behind.solids.depth, behind.hole, behind.outline)
    front = (people.rgb, people.alpha, people.depth, expected)
    _compose(*front, *solids, wall, colour, picture.rgb, picture.alpha, picture.depth)


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
            # Inverse depth of a plane is linear in image space, so this mean is the depth at the pixel centre.
            end[row, column] = high if outline[row, column] or inverse == 0.0 else FINER * FINER / inverse


@numba.njit(cache=True, nogil=True)
def _compose_alone(rgb, alpha, hit, wall, colour, out_rgb, out_alpha, depth):
    for row in range(alpha.shape[0]):
        for column in range(alpha.shape[1]):
            through = (np.float32(1) - alpha[row, column]) * wall
            for channel in range(3):
                out_rgb[row, column, channel] = rgb[row, column, channel] + through * colour[channel]
            out_alpha[row, column] = alpha[row, column] + through
            depth[row, column] = min(hit[row, column], NOTHING)


@numba.njit(cache=True, nogil=True)
def _compose(
    rgb, alpha, hit, expected, solid_rgb, solid_alpha, solid_depth, hole, outline, wall, colour, out_rgb, out_alpha, out
):
    share = np.float32(1 / (FINER * FINER))
    light = np.empty(4, np.float32)
    for row in range(alpha.shape[0]):
        for column in range(alpha.shape[1]):
            light[:] = 0
            nearest, second, inverse = np.inf, np.inf, 0.0
            for i in range(FINER * FINER):
                y, x = row * FINER + i // FINER, column * FINER + i % FINER
                z = solid_depth[y, x]  # inf for a holdout
                hidden = outline[row, column] and z < expected[row, column]
                through = np.float32(1) if hidden else np.float32(1) - alpha[row, column]
                free = (np.float32(0) if hole[y, x] else np.float32(1) - solid_alpha[y, x]) * wall
                for channel in range(3):
                    person = np.float32(0) if hidden else rgb[row, column, channel]
                    light[channel] += person + through * (solid_rgb[y, x, channel] + free * colour[channel])
                light[3] += np.float32(1) - through + through * (solid_alpha[y, x] + free)
                nearest, second, inverse = min(nearest, z), min(second, max(nearest, z)), inverse + 1.0 / z
            for channel in range(3):
                out_rgb[row, column, channel] = light[channel] * share
            out_alpha[row, column] = light[3] * share
            # The depth at which half of the samples are covered: opacity one half, the same definition as for humans.
            solid = second if outline[row, column] or inverse == 0.0 else 1.0 / (share * inverse)
            out[row, column] = min(hit[row, column], solid, NOTHING)
