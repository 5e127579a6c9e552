"""Draws the figure of the layout: its grid on the body, the body in its grid, and the boxes in a pose."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import torch
from numpy import ndarray as Array
from PIL import Image
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.surface import vertex_normals
from primdiffusion.primitives.anchors import CHARTS, Anchors, attach
from primdiffusion.primitives.primitives import GRID, Frames
from primdiffusion.raster.uv_atlas import UvRaster, rasterise_uv

COLOURS = {
    "torso": (235, 120, 110),
    "head": (250, 205, 90),
    "arm": (110, 190, 120),
    "hand": (90, 150, 230),
    "leg": (180, 130, 215),
    "foot": (120, 210, 215),
}
POSE = {
    "left_shoulder": (0.0, 0.0, -1.0),
    "right_shoulder": (0.0, 0.0, 1.0),
    "left_elbow": (0.0, -1.2, 0.0),
    "right_elbow": (0.0, 0.5, 0.0),
    "left_hip": (-0.9, 0.0, 0.1),
    "left_knee": (1.0, 0.0, 0.0),
    "spine2": (0.0, 0.3, 0.0),
}
"""Axis-angle in radians; the other joints are at rest."""
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
BOX_TRIANGLES = np.concatenate([SIDES[:, [0, 1, 2]], SIDES[:, [0, 2, 3]]])


def colour_of_cells(chart: torch.Tensor) -> Array:
    """[K, 3] in 0 .. 1; neighbouring cells alternate like a chessboard."""
    base = np.array([COLOURS[CHARTS[c].split("_")[-1]] for c in chart.tolist()]) / 255
    row, column = np.divmod(np.arange(len(base)), GRID)
    return base * (1 - 0.18 * ((row + column) % 2))[:, None]


def look_at(
    triangles: Array,
    colours: Array,
    yaw: float,
    centre: tuple[float, float, float],
    metres: float,
    size: tuple[int, int],
) -> Array:
    """[h, w, 3] orthographic view from `yaw` degrees to the right of the front; triangles painted from far to near."""
    angle = np.radians(yaw)
    turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    seen = (triangles - centre) @ turn.T
    order = np.argsort(seen[..., 2].mean(1))
    height, width = size
    flat = np.stack([seen[..., 0] / metres * height / width + 0.5, 0.5 - seen[..., 1] / metres], -1)
    raster: UvRaster = rasterise_uv(flat[order], height, width)
    normal = np.cross(seen[:, 1] - seen[:, 0], seen[:, 2] - seen[:, 0])
    facing = np.abs(normal[:, 2]) / (np.linalg.norm(normal, axis=1) + 1e-12)
    image = np.ones((height, width, 3))
    hit = raster.covered
    shown = order[raster.face[hit]]
    image[hit] = colours[shown] * (0.5 + 0.5 * facing[shown])[:, None]
    return image


def boxes_of(frames: Frames, colours: Array, share: float = 1.0) -> tuple[Array, Array]:
    """Triangles [12 K, 3, 3] and colours of the boxes, scaled by `share` about their centres."""
    position, rotation, half_extent = (
        a.double().numpy() for a in (frames.position, frames.rotation, frames.half_extent)
    )
    corners = position[:, None] + (CORNERS * half_extent[:, None] * share) @ rotation.transpose(0, 2, 1)
    return corners[:, BOX_TRIANGLES].reshape(-1, 3, 3), np.repeat(colours, 12, axis=0)


def cells_on_skin(vertices: Array, faces: Array, texels: UvRaster, colours: Array) -> tuple[Array, Array]:
    """The texel map as small squares, coloured by cell, on a dark body visible between them: triangles, colours."""
    points = (vertices[faces[texels.face]] * texels.barycentric[..., None]).sum(2)
    side = len(points) // GRID
    row, column = np.mgrid[: len(points) - 1, : len(points) - 1]
    inside = (row % side < side - 1) & (column % side < side - 1)
    row, column = row[inside], column[inside]
    square = np.stack(
        [points[row, column], points[row, column + 1], points[row + 1, column + 1], points[row + 1, column]], 1
    )
    colour = colours[row // side * GRID + column // side]
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(faces)).numpy()
    # Drawn thinner: triangles are painted whole from far to near, so neighbouring faces would show through the squares.
    inside = (vertices - 0.008 * normals)[faces]
    return (
        np.concatenate([inside, square[:, [0, 1, 2]], square[:, [0, 2, 3]]]),
        np.concatenate([np.full((len(faces), 3), 0.25), colour, colour]),
    )


def grid_picture(anchors: Anchors, size: int) -> Array:
    """[size, size, 3] the UV square, v up, in the same colours."""
    index = (np.arange(size) * GRID) // size
    row = GRID - 1 - index[:, None]
    colours = colour_of_cells(anchors.chart).reshape(GRID, GRID, 3)
    return colours[row, index[None, :]]


def posed(vertices: torch.Tensor) -> torch.Tensor:
    """The default body with arms and knees bent."""
    pose = torch.zeros(24, 3, dtype=vertices.dtype)
    for name, axis_angle in POSE.items():
        pose[JOINT_NAMES.index(name)] = torch.tensor(axis_angle, dtype=vertices.dtype)
    body = default_body().to(dtype=vertices.dtype)
    shaped = body.shape(torch.zeros(10, dtype=vertices.dtype))
    return shaped.pose(BodyPose.from_axis_angle(pose.flatten())).vertices


def draw_figure(anchors: Anchors, texels: UvRaster, vertices: torch.Tensor, faces: torch.Tensor) -> bytes:
    """PNG: the cells on the body from three sides, the UV square, the cells as plates, and the boxes in a pose."""
    colours = colour_of_cells(anchors.chart)
    frames = attach(anchors, vertices, faces)
    skin = cells_on_skin(vertices.numpy(), faces.numpy(), texels, colours)
    thin = dataclasses.replace(frames, half_extent=frames.half_extent * torch.tensor([0.5, 0.5, 0.1]))
    in_pose = attach(anchors, posed(vertices), faces)
    size, middle = 430, (0.0, -0.28, 0.03)
    views = ((0, 430), (90, 150), (180, 430))
    above = [look_at(*skin, yaw, middle, 1.85, (size, width)) for yaw, width in views]
    below = [look_at(*boxes_of(thin, colours), 0, middle, 1.85, (size, 430))]
    left_hand, left_foot = (0.8, 0.25, 0.05), (0.15, -1.1, 0.05)
    below += [np.concatenate([look_at(*skin, 30, spot, 0.4, (size // 2, 215)) for spot in (left_hand, left_foot)])]
    below += [look_at(*boxes_of(in_pose, colours), yaw, (0.0, -0.27, 0.05), 2.1, (size, 380)) for yaw in (0, 50)]
    square = np.ones((size, size, 3))
    square[15:-15, 15:-15] = grid_picture(anchors, size - 30)
    rows = [np.concatenate([*above, square], 1), np.concatenate(below, 1)]
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=1) for row in rows]
    file = io.BytesIO()
    rgb = Image.fromarray((np.clip(np.concatenate(padded), 0, 1) * 255).astype(np.uint8))
    rgb.quantize(96, dither=Image.Dither.NONE).save(file, format="PNG", optimize=True)
    return file.getvalue()
