"""Pictures on assets: of a file, or of a clay figure in a pose; never drawn by Blender, so no window is needed."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES, PARENTS

SIDE = 256
"""Pixels a side: what Blender makes of its own previews."""
_THICK_M = {"pelvis": 0.11, "spine1": 0.12, "spine2": 0.12, "spine3": 0.12, "neck": 0.055, "head": 0.1, "collar": 0.07}
_LIMB_M = {"hip": 0.09, "knee": 0.075, "ankle": 0.05, "foot": 0.04, "shoulder": 0.06, "elbow": 0.045, "wrist": 0.035}
_THIN_M = 0.035
_ALONG = np.linspace(0.0, 1.0, 32)
_SKULL_M = 0.09
"""From the head's joint to the middle of the skull."""
_CLAY, _FRAME_M = np.array([0.80, 0.62, 0.50]), 2.2
_YAW = np.deg2rad(25.0)
_LIGHT = np.array([-0.35, 0.65, 0.67])


def show(asset: bpy.types.ID, picture: NDArray) -> None:
    """Give an asset its preview: RGBA [SIDE, SIDE, 4] from 0 to 1, straight alpha, bottom row first."""
    preview = asset.preview_ensure()
    preview.image_size = picture.shape[1::-1]
    preview.image_pixels_float.foreach_set(np.ascontiguousarray(picture, np.float32).ravel())


def picture_of_file(path: Path) -> NDArray[np.float32]:
    """The picture of an image file, as `show` wants it: squared off with nothing, then scaled.

    Raises OSError where it is none.
    """
    try:
        image = bpy.data.images.load(str(path))
    except RuntimeError as error:
        raise OSError(f"{path} cannot be read as a picture: choose a PNG or JPEG") from error
    try:
        width, height = image.size
        if not (width and height):
            raise OSError(f"{path} cannot be read as a picture: choose a PNG or JPEG")
        side = max(width, height)
        image.scale(max(1, width * SIDE // side), max(1, height * SIDE // side))
        width, height = image.size
        pixels = np.empty(width * height * 4, np.float32)
        image.pixels.foreach_get(pixels)
    finally:
        bpy.data.images.remove(image)
    picture = np.zeros((SIDE, SIDE, 4), np.float32)
    x, y = (SIDE - width) // 2, (SIDE - height) // 2
    picture[y : y + height, x : x + width] = pixels.reshape(height, width, 4)
    return picture


def clay_figure(joints: NDArray) -> NDArray[np.float32]:
    """Somebody whose joints are at [24, 3] (y up, metres, facing +z), from the front and a little from the side.

    Balls along the bones, the nearest of each pixel, lit from above: a picture as `show` wants it.
    """
    turn = np.array([[np.cos(_YAW), 0, np.sin(_YAW)], [0, 1, 0], [-np.sin(_YAW), 0, np.cos(_YAW)]])
    centres, radii = _balls(joints @ turn.T)
    middle = (centres.min(0) + centres.max(0)) / 2
    frame = max(_FRAME_M, 1.1 * np.ptp(centres[:, :2], axis=0).max())
    grid = ((np.arange(SIDE) + 0.5) / SIDE - 0.5) * frame
    depth = np.full((SIDE, SIDE), -np.inf)
    light = np.zeros((SIDE, SIDE))
    for centre, radius in zip(centres, radii, strict=True):
        around = (abs(grid + middle[1] - centre[1]) < radius), (abs(grid + middle[0] - centre[0]) < radius)
        window = np.ix_(*around)
        y = (grid[around[0]] + middle[1] - centre[1])[:, None]
        x = (grid[around[1]] + middle[0] - centre[0])[None, :]
        bulge = radius**2 - x**2 - y**2
        z = np.sqrt(np.maximum(bulge, 0.0))
        nearer = (bulge > 0) & (centre[2] + z > depth[window])
        lit = 0.25 + 0.75 * np.clip((x * _LIGHT[0] + y * _LIGHT[1] + z * _LIGHT[2]) / radius, 0, 1)
        depth[window] = np.where(nearer, centre[2] + z, depth[window])
        light[window] = np.where(nearer, lit, light[window])
    picture = np.zeros((SIDE, SIDE, 4), np.float32)
    picture[..., :3] = light[..., None] * _CLAY
    picture[..., 3] = np.isfinite(depth)
    return picture


def _balls(joints: NDArray) -> tuple[NDArray, NDArray]:
    centres, radii = [], []
    for child, parent in enumerate(PARENTS):
        if parent < 0:
            continue
        thick = _radius(JOINT_NAMES[parent]), _radius(JOINT_NAMES[child])
        centres.append(joints[parent] * (1 - _ALONG[:, None]) + joints[child] * _ALONG[:, None])
        radii.append(thick[0] * (1 - _ALONG) + thick[1] * _ALONG)
    head, neck = joints[JOINT_NAMES.index("head")], joints[JOINT_NAMES.index("neck")]
    up = (head - neck) / max(float(np.linalg.norm(head - neck)), 1e-9)
    centres.append((head + up * _SKULL_M)[None])
    radii.append(np.array([0.11]))
    return np.concatenate(centres), np.concatenate(radii)


def _radius(joint: str) -> float:
    return _THICK_M.get(joint) or _THICK_M.get(joint.partition("_")[2]) or _LIMB_M.get(joint.partition("_")[2], _THIN_M)
