"""Primitives drawn as shaded boxes, one colour each: what the method is made of (the paper's figure)."""

from __future__ import annotations

import colorsys

import numba
import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from numpy import ndarray
from torch import Tensor

from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.srgb import decode_srgb
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.raster.z_buffer import nearest_triangles
from primdiffusion.render.solids import Layer, eye_of

LIT = (0.35, 0.65)
"""A face's light: the first part always, the second times |n . ray|."""
EDGE_PIXELS = 0.7
"""Half the width of the dark lines along a box's edges."""
EDGE_SHARE = 0.12
"""The same as a share of the box's shortest half side at most: small boxes keep their colour."""
EDGE_LIGHT = 0.3
"""What a line leaves of the light."""
TRIANGLES = 12
"""Of a box: two for each face, faces in the order -x, +x, -y, +y, -z, +z."""


def draw_boxes(
    primitives: Primitives,
    camera: Camera,
    group: Int[Tensor, "k"] | None = None,
    clip: tuple[float, float] = (0.0, np.inf),
) -> Layer:
    """The nearest box in each pixel: a colour for each box, faces lit by how they are turned, edges darkened.

    `primitives` are unbatched. Boxes of one `group` (say, a UV chart) share a hue and differ in lightness; without
    groups hues differ. `clip` are depths along the optical axis: a box that crosses one is cut open there. Boxes with
    an extent of zero or less are not drawn. Pixels are wholly covered or not at all. Not differentiable.
    """
    boxes = primitives.map(lambda tensor: tensor.detach().cpu().double())
    position, rotation, half_extent = (t.numpy() for t in (boxes.position, boxes.rotation, boxes.half_extent))
    solid = np.flatnonzero((half_extent > 0).all(-1))
    colour = box_colours(len(position), group)[solid]
    position, rotation, half_extent = position[solid], rotation[solid], half_extent[solid]
    nearest = nearest_triangles(_triangles(position, rotation, half_extent), camera, clip)
    rgb = np.zeros((camera.height, camera.width, 3), np.float32)
    pixel = 1 / float(camera.intrinsics[0, 0])
    _shade(nearest.triangle, nearest.depth, position, rotation, half_extent, colour, *eye_of(camera), pixel, rgb)
    return Layer(rgb, (nearest.triangle >= 0).astype(np.float32), nearest.depth)


def box_colours(count: int, group: Int[Tensor, "k"] | None = None) -> Float32[ndarray, "k 3"]:
    """Linear colours of boxes 0, 1, ...: hue by group (by number without groups), lightness by number."""
    k = np.arange(count)
    hue = ((k if group is None else torch.as_tensor(group).cpu().numpy()) * 0.618034) % 1
    lightness = 0.42 + 0.33 * ((k * 0.754878) % 1)
    colours = [colorsys.hls_to_rgb(h, light, 0.7) for h, light in zip(hue.tolist(), lightness.tolist(), strict=True)]
    return decode_srgb(np.array(colours, np.float32).reshape(-1, 3))


def _triangles(position: ndarray, rotation: ndarray, half_extent: ndarray) -> Float[ndarray, "f 3 3"]:
    """Two triangles for each face of each box."""
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
def _shade(triangle, depth, position, rotation, half_extent, colour, eye, direction, pixel, rgb):
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
