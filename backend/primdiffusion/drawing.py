"""Draw a scene: march the humans, rasterise the solids, and composite both by depth.

The marcher's rays end at solids, so solids may be in front of, behind or inside a human; the remaining transmittance
shows the solid, or else the background.

Solids are antialiased with FINER x FINER samples per pixel; humans are sampled once, at the pixel's centre. If one
surface covers the pixel, the marcher's ray ends at that surface and the remaining transmittance shows it. At an outline
the ray does not end: each sample then shows its solid alone if that is nearer than the humans' expected depth, and the
humans over the solid otherwise.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float32, Int
from numpy import ndarray
from torch import Tensor

from primdiffusion.formats.requests import VIEWS, View
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import Image, decode_srgb
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.raster.z_buffer import nearest_triangles
from primdiffusion.render.image import depth_colours
from primdiffusion.render.lattice import check_camera
from primdiffusion.render.march import MarchSettings, Span, march
from primdiffusion.render.solids import Solids, draw_boxes, shade_solids

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
    """Image of the solids, at FINER times the resolution."""
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


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Humans and opaque meshes in world space."""

    primitives: Primitives | None
    """Primitives of all humans, unbatched (`Primitives.together`); None if there are none."""
    solids: Solids | None = None
    chart: Int[Tensor, "k"] | None = None
    """The body region of each primitive; sets its hue in the view "boxes"."""


@dataclasses.dataclass(frozen=True)
class ViewSettings:
    """View settings."""

    view: View = VIEWS[0]
    background: tuple[float, float, float] | None = None
    """Linear RGB; None is transparent."""
    clip: tuple[float, float] = (0.0, math.inf)
    """Near and far clipping depths along the optical axis, metres."""
    settings: MarchSettings = MarchSettings()  # noqa: RUF009  frozen

    def __post_init__(self) -> None:
        """Raise ValueError for an unknown view or clip planes in the wrong order."""
        if self.view not in VIEWS:
            raise ValueError(f"unknown view {self.view!r}; choose from {', '.join(VIEWS)}")
        start, end = self.clip
        if not 0 <= start < end:
            raise ValueError(f"the clip distances are {start} and {end} m: give a start of at least 0 and a larger end")


def draw(scene: Scene, camera: Camera, look: ViewSettings = ViewSettings()) -> Image:
    """Draw `scene`: humans over solids over the background.

    Depth is the nearer of a human's first hit (opacity one half) and a solid; NOTHING without either. A holdout hides
    humans behind it and leaves a hole (colours 0, no depth) unless a human is in front of it. The view "alpha" is
    opaque, with the humans' coverage as grey; "depth" colours humans (by expected depth) and solids with
    `depth_colours`.
    Computes on the device of `scene.primitives`; the result is on the CPU. Raises ValueError as `march` does.
    """
    picture = Image.blank(camera.width, camera.height)
    draw_into(picture, scene, camera, look)
    return picture


def draw_into(picture: Image, scene: Scene, camera: Camera, look: ViewSettings) -> float:
    """Draw as `draw` into an existing picture of the camera's size; return the seconds spent in the marcher."""
    check_camera(camera)
    behind = None if scene.solids is None else backdrop(scene.solids, camera, look.clip)
    end = None if behind is None else behind.end
    if scene.primitives is None or scene.primitives.position.shape[0] == 0:
        empty = Image.blank(camera.width, camera.height)
        people = People(empty, empty.depth, 0.0)
    elif look.view == "boxes":
        people = _boxes(draw_boxes(scene.primitives, camera, scene.chart, look.clip), end)
    else:
        people = _marched(scene.primitives, camera, look, end)
    if look.view == "depth":
        span = depth_span(scene.primitives, camera, look.clip)
        people, behind = _in_depth(people, span), _solids_in_depth(behind, span)
    background = look.background
    if look.view == "alpha":
        people, behind, background = _in_grey(people), _solids_in_black(behind), (0.0, 0.0, 0.0)
    if behind is None:
        over_background(picture, people.layer, background)
    else:
        over_solids(picture, people.layer, people.expected, behind, background)
    if look.view == "alpha":
        _encode_coverage(picture)
    return people.seconds


def depth_span(primitives: Primitives | None, camera: Camera, clip: tuple[float, float]) -> tuple[float, float]:
    """The range of depths along the optical axis covered by the boxes, cut to `clip`.

    Does not depend on the crop of the image. (1, 2) if there are no boxes.
    """
    if primitives is None or primitives.position.shape[0] == 0:
        return 1.0, 2.0
    axis, offset = camera.world_to_camera[2, :3], camera.world_to_camera[2, 3]
    depth = primitives.position @ axis + offset
    reach = ((axis @ primitives.rotation).abs() * primitives.half_extent).sum(-1)
    near, far = max(float((depth - reach).min()), clip[0]), min(float((depth + reach).max()), clip[1])
    return near, max(far, near)


@dataclasses.dataclass(frozen=True, eq=False)
class People:
    """The rendered humans, before compositing."""

    layer: Image
    expected: Float32[ndarray, "h w"]
    """Expected depth along the optical axis; inf where no human is hit."""
    seconds: float
    """Time spent in the marcher."""


def _marched(primitives: Primitives, camera: Camera, look: ViewSettings, end: ndarray | None) -> People:
    secant = camera.secants().cpu().numpy()
    span = _span(primitives, camera, look.clip, end, secant)
    began = time.perf_counter()
    rendering = march(primitives, camera, look.settings, span=span)
    rgb, alpha, depth, first_hit = (
        field.cpu().numpy() for field in (rendering.rgb, rendering.alpha, rendering.depth, rendering.first_hit)
    )
    seconds = time.perf_counter() - began
    needed = end is not None or look.view == "depth"
    return People(Image(rgb, alpha, first_hit / secant), depth / secant if needed else depth, seconds)


def _boxes(boxes: Image, end: ndarray | None) -> People:
    """The boxes that are not hidden by solids."""
    if end is None:
        return People(boxes, boxes.depth, 0.0)
    seen = boxes.depth < end
    depth = np.where(seen, boxes.depth, np.float32(np.inf))
    return People(Image(boxes.rgb * seen[..., None], boxes.alpha * seen, depth), depth, 0.0)


def _in_depth(people: People, span: tuple[float, float]) -> People:
    alpha = people.layer.alpha[..., None]
    rgb = np.where(alpha > 0, _linear_depth(people.expected, span), 0) * alpha
    return dataclasses.replace(people, layer=dataclasses.replace(people.layer, rgb=rgb))


def _solids_in_depth(behind: Backdrop | None, span: tuple[float, float]) -> Backdrop | None:
    if behind is None:
        return None
    rgb = _linear_depth(behind.solids.depth, span) * behind.solids.alpha[..., None]
    return dataclasses.replace(behind, solids=dataclasses.replace(behind.solids, rgb=rgb))


def _in_grey(people: People) -> People:
    alpha = people.layer.alpha
    rgb = np.ascontiguousarray(np.broadcast_to(alpha[..., None], (*alpha.shape, 3)))
    return dataclasses.replace(people, layer=dataclasses.replace(people.layer, rgb=rgb))


def _solids_in_black(behind: Backdrop | None) -> Backdrop | None:
    if behind is None:
        return None
    return dataclasses.replace(behind, solids=dataclasses.replace(behind.solids, rgb=np.zeros_like(behind.solids.rgb)))


def _encode_coverage(picture: Image) -> None:
    """Replace coverage by opaque linear grey whose sRGB encoding equals the coverage."""
    picture.rgb[:] = decode_srgb(picture.rgb)
    picture.alpha[:] = 1


def _span(
    primitives: Primitives, camera: Camera, clip: tuple[float, float], end: ndarray | None, secant: ndarray
) -> Span | None:
    """Start and end of each ray; None if neither clip planes nor solids intersect the boxes."""
    near, far = depth_span(primitives, camera, (-math.inf, math.inf))
    hidden = end is not None and bool((end < far).any())
    if not hidden and (clip[0] <= near or clip[0] == 0) and far <= clip[1]:
        return None
    depth = np.full_like(secant, clip[1]) if end is None else np.minimum(end, np.float32(clip[1]))
    limits = (
        torch.from_numpy(limit).to(primitives.position) for limit in (secant * np.float32(clip[0]), depth * secant)
    )
    return Span(*limits)


def _linear_depth(depth: ndarray, span: tuple[float, float]) -> Float32[ndarray, "h w 3"]:
    return decode_srgb(depth_colours(depth, *span).astype(np.float32))


BAND_SECONDS = 0.3
"""Target duration of a band, and so the latency of a cancel."""
FIRST_PIXELS = 2**15
"""Pixels in the first band when the drawing speed is unknown."""
MOST_PIXELS = 2**19
"""Pixels in any band; bounds memory, about 100 bytes per pixel."""
GROWTH = 4
"""Largest ratio of rows between consecutive bands: the top of an image is often empty and misleadingly fast."""


@dataclasses.dataclass(frozen=True)
class DrawProgress:
    """Progress of an image."""

    rows: int
    """Finished rows, from the top."""
    seconds_march: float
    """Time spent in the marcher so far."""
    pixels_a_second: float
    """Slowest band of this image, an estimate for the next one; the first band is skipped unless it is the only one,
    because it may include loading compiled code."""


def draw_in_bands(
    picture: Image, scene: Scene, camera: Camera, look: ViewSettings, pixels_a_second: float | None = None
) -> Iterator[DrawProgress]:
    """Same as `draw`, but fills `picture` in bands from the top; `pixels_a_second` is the measured speed, if known."""
    top, rows, seconds = 0, camera.height, 0.0
    speeds: list[float] = []
    while top < camera.height:
        rows = min(_rows(camera.width, pixels_a_second), rows * GROWTH, camera.height - top)
        began = time.perf_counter()
        part = camera.crop(0, top, camera.width, rows)
        band = Image(*(values[top : top + rows] for values in (picture.rgb, picture.alpha, picture.depth)))
        seconds += draw_into(band, scene, part, look)
        pixels_a_second = rows * camera.width / max(time.perf_counter() - began, 1e-6)
        speeds.append(pixels_a_second)
        top += rows
        yield DrawProgress(top, seconds, min(speeds[1:] or speeds))


def _rows(width: int, pixels_a_second: float | None) -> int:
    pixels = FIRST_PIXELS if pixels_a_second is None else min(BAND_SECONDS * pixels_a_second, MOST_PIXELS)
    return max(int(pixels / width), 1)
