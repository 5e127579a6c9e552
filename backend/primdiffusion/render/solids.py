"""Opaque objects beside humans, and primitives as boxes: flat-coloured triangles with simple lighting."""

from __future__ import annotations

import colorsys
import dataclasses

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray
from torch import Tensor

from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import Image, decode_srgb
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.raster.z_buffer import NearestTriangle, nearest_triangles

SKY = 0.45
"""Light from above: SKY * (1 + n_up) / 2."""
HEADLIGHT = 0.55
"""Light from the viewer: HEADLIGHT * |n . ray|. SKY + HEADLIGHT is 1, so colours are never brightened."""


@dataclasses.dataclass(frozen=True, eq=False)
class Solids:
    """Opaque two-sided triangles in world space."""

    corners: Float32[ndarray, "f 3 3"]
    """Metres."""
    colour: Float32[ndarray, "f 3"]
    """Linear RGB."""
    holdout: Bool[ndarray, "f"]
    """Whether the triangle is a holdout: it hides what is behind it and leaves a hole."""

    def __post_init__(self) -> None:
        """Raise ValueError if shapes do not match or values are not finite."""
        count = len(self.corners)
        for name, shape in (("corners", (count, 3, 3)), ("colour", (count, 3)), ("holdout", (count,))):
            value = getattr(self, name)
            if value.shape != shape:
                raise ValueError(f"{name} of the solids has shape {value.shape}; it must be {shape}")
            if not np.isfinite(value).all():
                raise ValueError(f"{name} of the solids holds NaN or infinite values: repair the meshes")


def shade_solids(solids: Solids, nearest: NearestTriangle, camera: Camera) -> Image:
    """Shade the solids with a sky and a headlight, flat per triangle; holdouts are empty, with infinite depth.

    colour * (SKY (1 + n_up) / 2 + HEADLIGHT |n . ray|), with the normal n towards the viewer. No antialiasing.
    """
    layer = Image.blank(camera.width, camera.height)
    _, direction = eye_of(camera)
    seen = (nearest.triangle, nearest.depth, direction)
    _shade(solids.corners, solids.colour, solids.holdout, *seen, layer.rgb, layer.alpha, layer.depth)
    return layer


def eye_of(camera: Camera) -> tuple[ndarray, ndarray]:
    """Camera position [3], and the matrix [3, 3] from (u, v, 1) to the world direction with depth 1."""
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


LIT = (0.35, 0.65)
"""Light of a face: constant part, and factor on |n . ray|."""
EDGE_PIXELS = 0.7
"""Half the width of the dark lines along a box's edges."""
EDGE_SHARE = 0.12
"""Its limit relative to the box's shortest half extent, so that small boxes are not all line."""
EDGE_LIGHT = 0.3
"""Factor on the light along a line."""
TRIANGLES = 12
"""Triangles of a box: two for each face, in the order -x, +x, -y, +y, -z, +z."""


def draw_boxes(
    primitives: Primitives,
    camera: Camera,
    group: Int[Tensor, "k"] | None = None,
    clip: tuple[float, float] = (0.0, np.inf),
) -> Image:
    """Render the boxes themselves, as in the paper's figure: a colour for each, faces lit, edges darkened.

    `primitives` are unbatched. Boxes of one `group` (such as a UV chart) share a hue and differ in lightness; without
    groups hues differ. Boxes are cut at the depths `clip` along the optical axis; those with an extent of zero or less
    are not drawn. No antialiasing. Not differentiable.
    """
    boxes = primitives.map(lambda tensor: tensor.detach().cpu().double())
    position, rotation, half_extent = (t.numpy() for t in (boxes.position, boxes.rotation, boxes.half_extent))
    solid = np.flatnonzero((half_extent > 0).all(-1))
    colour = box_colours(len(position), group)[solid]
    position, rotation, half_extent = position[solid], rotation[solid], half_extent[solid]
    nearest = nearest_triangles(_triangles(position, rotation, half_extent), camera, clip)
    rgb = np.zeros((camera.height, camera.width, 3), np.float32)
    pixel = 1 / float(camera.intrinsics[0, 0])
    _shade_boxes(nearest.triangle, nearest.depth, position, rotation, half_extent, colour, *eye_of(camera), pixel, rgb)
    return Image(rgb, (nearest.triangle >= 0).astype(np.float32), nearest.depth)


def box_colours(count: int, group: Int[Tensor, "k"] | None = None) -> Float32[ndarray, "k 3"]:
    """Linear colours of boxes 0, 1, ...: hue by group (by index without groups), lightness by index."""
    k = np.arange(count)
    hue = ((k if group is None else torch.as_tensor(group).cpu().numpy()) * 0.618034) % 1
    lightness = 0.42 + 0.33 * ((k * 0.754878) % 1)
    colours = [colorsys.hls_to_rgb(h, light, 0.7) for h, light in zip(hue.tolist(), lightness.tolist(), strict=True)]
    return decode_srgb(np.array(colours, np.float32).reshape(-1, 3))


def _triangles(position: ndarray, rotation: ndarray, half_extent: ndarray) -> Float[ndarray, "f 3 3"]:
    """Corners of two triangles per face of each box."""
    faces = np.empty((6, 4, 3))
    around = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    for face in range(6):
        axis = face // 2
        faces[face, :, axis] = 2 * (face % 2) - 1
        faces[face][:, [(axis + 1) % 3, (axis + 2) % 3]] = around
    local = faces.reshape(24, 3) * half_extent[:, None]
    corners = (position[:, None] + local @ rotation.transpose(0, 2, 1)).reshape(-1, 4, 3)
    return corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)


@numba.njit(cache=True, nogil=True)
def _shade_boxes(triangle, depth, position, rotation, half_extent, colour, eye, direction, pixel, rgb):
    ray = np.empty(3)
    for row in range(triangle.shape[0]):
        for column in range(triangle.shape[1]):
            if triangle[row, column] < 0:
                continue
            k, axis = triangle[row, column] // TRIANGLES, triangle[row, column] % TRIANGLES // 4
            z = depth[row, column]
            for i in range(3):
                ray[i] = direction[i, 0] * (column + 0.5) + direction[i, 1] * (row + 0.5) + direction[i, 2]
            facing = 0.0
            for i in range(3):
                facing += rotation[k, i, axis] * ray[i]
            facing = abs(facing) / np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
            to_edge = np.inf
            for other in range(1, 3):
                side = (axis + other) % 3
                place = 0.0
                for i in range(3):
                    place += rotation[k, i, side] * (eye[i] + z * ray[i] - position[k, i])
                to_edge = min(to_edge, half_extent[k, side] - abs(place))
            line = min(EDGE_PIXELS * z * pixel, EDGE_SHARE * half_extent[k].min())
            inside = min(max(to_edge / line - 0.5, 0.0), 1.0)
            light = (LIT[0] + LIT[1] * facing) * (EDGE_LIGHT + (1.0 - EDGE_LIGHT) * inside)
            for channel in range(3):
                rgb[row, column, channel] = colour[k, channel] * light
