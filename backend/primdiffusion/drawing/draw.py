"""A scene and a camera to a picture: people marched, solids rasterised, both composited by depth.

A ray of the marcher ends where it meets a solid, so a solid may stand before, behind or inside a person; what people
leave of a ray shows the solid there, or else the background. Solids cover a pixel wholly or not at all (they are seen
through its centre); render at twice the size where their edges must be smooth.
"""

from __future__ import annotations

import dataclasses
import math
import time

import numba
import numpy as np
import torch
from jaxtyping import Float32
from numpy import ndarray

from primdiffusion.drawing.scene import NOTHING, Look, Picture, Scene
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.srgb import decode_srgb
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.boxes import draw_boxes
from primdiffusion.render.image import depth_colours
from primdiffusion.render.march import Span, march
from primdiffusion.render.solids import Layer, shade_solids
from primdiffusion.render.triangles import Nearest, nearest_triangles


def draw(scene: Scene, camera: Camera, look: Look = Look()) -> Picture:  # noqa: B008
    """The picture of `scene`: people over solids over the background.

    Depth is the nearer of a person's first hit (opacity one half) and a solid. A holdout hides people behind it and
    leaves a hole: combined 0, and no depth, unless a person stands before it. In the view "alpha" all is opaque and
    grey is the people's coverage; "depth" gives people (expected depth) and solids the colours of `depth_colours`.
    Works on the device of `scene.primitives`; the picture is on the CPU. Raises ValueError as `march` does.
    """
    picture = Picture.blank(camera.width, camera.height)
    draw_into(picture, scene, camera, look)
    return picture


def draw_into(picture: Picture, scene: Scene, camera: Camera, look: Look) -> float:
    """As `draw`, into a picture of the camera's size; returns the seconds of the marcher alone."""
    solids, nearest, behind, seconds = scene.solids, Nearest.nothing(camera), Layer.nothing(camera), 0.0
    if solids is not None:
        nearest = nearest_triangles(solids.corners, camera, look.clip)
        behind = shade_solids(solids, nearest, camera)
    if scene.primitives is None or scene.primitives.position.shape[0] == 0:
        people = Layer.nothing(camera)
    elif look.view == "boxes":
        people = _hidden(draw_boxes(scene.primitives, camera, scene.chart, look.clip), nearest)
    else:
        people, seconds = _people(scene.primitives, camera, look, nearest)
    if look.view == "alpha":
        _write_coverage(picture, people, behind)
        return seconds
    if look.view == "depth" and solids is not None:
        span = depth_span(scene.primitives, camera, look.clip)
        behind = dataclasses.replace(behind, rgb=_linear_depth(behind.depth, span) * behind.alpha[..., None])
    wall = np.broadcast_to(np.float32(look.background is not None), nearest.depth.shape)
    if solids is not None and solids.holdout.any():
        wall = wall * ~((nearest.triangle >= 0) & solids.holdout[nearest.triangle])
    colour = np.array(look.background or (0, 0, 0), np.float32)
    _compose(*_arrays(people), *_arrays(behind), wall, colour, picture.combined, picture.depth)
    return seconds


def depth_span(primitives: Primitives | None, camera: Camera, clip: tuple[float, float]) -> tuple[float, float]:
    """The depths along the optical axis between which the boxes lie, as far as `clip` shows them.

    The same for all parts of a picture, whatever they show. (1, 2) where there is no box.
    """
    if primitives is None or primitives.position.shape[0] == 0:
        return 1.0, 2.0
    axis, offset = camera.world_to_camera[2, :3], camera.world_to_camera[2, 3]
    depth = primitives.position @ axis + offset
    reach = ((axis @ primitives.rotation).abs() * primitives.half_extent).sum(-1)
    near, far = max(float((depth - reach).min()), clip[0]), min(float((depth + reach).max()), clip[1])
    return near, max(far, near)


def _people(primitives: Primitives, camera: Camera, look: Look, nearest: Nearest) -> tuple[Layer, float]:
    """The people by marching, in colour or in depth, and the seconds of the marcher."""
    secant = _secants(camera)
    span = _span(primitives, camera, look.clip, nearest, secant)
    began = time.perf_counter()
    rendering = march(primitives, camera, look.settings, span=span)
    rgb, alpha, depth, first_hit = (
        field.cpu().numpy() for field in (rendering.rgb, rendering.alpha, rendering.depth, rendering.first_hit)
    )
    seconds = time.perf_counter() - began
    if look.view == "depth":
        colours = _linear_depth(depth / secant, depth_span(primitives, camera, look.clip))
        rgb = np.where(alpha[..., None] > 0, colours, 0) * alpha[..., None]
    return Layer(rgb, alpha, first_hit / secant), seconds


def _secants(camera: Camera) -> Float32[ndarray, "h w"]:
    """Distance along a pixel's ray for each metre along the optical axis."""
    secant = np.empty((camera.height, camera.width), np.float32)
    _fill_secants(secant, np.linalg.inv(camera.intrinsics.detach().cpu().double().numpy()))
    return secant


@numba.njit(cache=True, nogil=True)
def _fill_secants(secant, inverse):
    for row in range(secant.shape[0]):
        y = inverse[1, 1] * (row + 0.5) + inverse[1, 2]
        x = inverse[0, 1] * (row + 0.5) + inverse[0, 2]
        for column in range(secant.shape[1]):
            secant[row, column] = math.sqrt(1.0 + y * y + (x + inverse[0, 0] * (column + 0.5)) ** 2)


def _span(
    primitives: Primitives, camera: Camera, clip: tuple[float, float], nearest: Nearest, secant: ndarray
) -> Span | None:
    """Where rays begin and end; None where neither planes nor solids can cut a box."""
    near, far = depth_span(primitives, camera, (-math.inf, math.inf))
    hidden = bool((nearest.depth < far).any())
    if not hidden and (clip[0] <= near or clip[0] == 0) and far <= clip[1]:
        return None
    ends = np.minimum(nearest.depth, np.float32(clip[1])) * secant
    limits = (torch.from_numpy(limit).to(primitives.position) for limit in (secant * np.float32(clip[0]), ends))
    return Span(*limits)


def _hidden(layer: Layer, nearest: Nearest) -> Layer:
    """What of opaque pixels is not hidden by solids."""
    seen = layer.depth < nearest.depth
    return Layer(layer.rgb * seen[..., None], layer.alpha * seen, np.where(seen, layer.depth, np.float32(np.inf)))


def _linear_depth(depth: ndarray, span: tuple[float, float]) -> Float32[ndarray, "h w 3"]:
    return decode_srgb(depth_colours(depth, *span).astype(np.float32))


def _write_coverage(picture: Picture, people: Layer, behind: Layer) -> None:
    """Grey that an sRGB screen shows as bright as alpha says."""
    picture.combined[..., :3] = decode_srgb(people.alpha)[..., None]
    picture.combined[..., 3] = 1
    picture.depth[:] = np.minimum(np.minimum(people.depth, behind.depth), np.float32(NOTHING))


def _arrays(layer: Layer) -> tuple[ndarray, ndarray, ndarray]:
    return layer.rgb, layer.alpha, layer.depth


@numba.njit(cache=True, nogil=True)
def _compose(rgb, alpha, hit, behind_rgb, behind_alpha, behind_depth, wall, colour, combined, depth):
    """People over solids over a wall of one colour where there is one."""
    for row in range(alpha.shape[0]):
        for column in range(alpha.shape[1]):
            left = np.float32(1) - alpha[row, column]
            through = left * (np.float32(1) - behind_alpha[row, column]) * wall[row, column]
            for channel in range(3):
                light = rgb[row, column, channel] + left * behind_rgb[row, column, channel]
                combined[row, column, channel] = light + through * colour[channel]
            combined[row, column, 3] = alpha[row, column] + left * behind_alpha[row, column] + through
            depth[row, column] = min(hit[row, column], behind_depth[row, column], NOTHING)
