"""The scene's camera and render border, as Blender's own renderers use them."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from .view import PinholeView, view_from_matrices, without_scale


def camera_view(
    camera: bpy.types.Object, depsgraph: bpy.types.Depsgraph, size: tuple[int, int], subject: NDArray
) -> PinholeView:
    """The view of a camera object in a picture of `size` (width, height), by Blender's own projection, which includes
    lens, shift, sensor fit and pixel aspect.

    Raises ValueError for a panoramic camera, one that is scaled to zero and one that clips everything.
    """
    evaluated = camera.evaluated_get(depsgraph)
    data = evaluated.data
    if evaluated.type != "CAMERA" or data.type not in ("PERSP", "ORTHO"):
        kind = data.type.lower() if evaluated.type == "CAMERA" else evaluated.type.lower()
        raise ValueError(
            f"the camera {camera.name!r} is of type {kind}; PrimDiffusion draws perspective and orthographic cameras: "
            "change its lens type, or choose another camera"
        )
    if not data.clip_start < data.clip_end:
        raise ValueError(
            f"the camera {camera.name!r} clips everything, from {data.clip_start:.4g} m to {data.clip_end:.4g} m: "
            "let its Clip End be beyond its Clip Start"
        )
    axes = without_scale(evaluated.matrix_world)
    if not abs(np.linalg.det(axes)) > 0:
        raise ValueError(f"the camera {camera.name!r} or a parent of it is scaled to zero: give it a scale")
    render = depsgraph.scene.render
    projection = camera.calc_matrix_camera(
        depsgraph, x=size[0], y=size[1], scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y
    )
    return view_from_matrices(projection, np.linalg.inv(axes), (data.clip_start, data.clip_end), size, subject)


def wanted_region(render: bpy.types.RenderSettings, size: tuple[int, int]) -> list[int] | None:
    """The border as [x, y, width, height] in pixels from the left and the bottom, None for the whole picture.

    Truncated in float32, as Blender does: the engine's result has exactly this size.
    """
    if not render.use_border:
        return None
    low = [int(np.float32(edge) * np.float32(n)) for edge, n in zip(_corner(render, "min"), size, strict=True)]
    high = [int(np.float32(edge) * np.float32(n)) for edge, n in zip(_corner(render, "max"), size, strict=True)]
    return [low[0], low[1], high[0] - low[0], high[1] - low[1]]


def camera_frame(context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> tuple[NDArray, NDArray]:
    """Lowest and highest corner [2] of the camera's picture, pixels of the region."""
    region, camera = context.region, context.space_data.camera
    corners = np.array(camera.data.view_frame(scene=depsgraph.scene), np.float64)
    homogeneous = np.concatenate([corners, np.ones((4, 1))], 1)
    clip = homogeneous @ np.array(context.region_data.window_matrix, np.float64).T
    pixels = (clip[:, :2] / clip[:, 3:] + 1) / 2 * [region.width, region.height]
    return pixels.min(0), pixels.max(0)


def _corner(render: bpy.types.RenderSettings, which: str) -> tuple[float, float]:
    return getattr(render, f"border_{which}_x"), getattr(render, f"border_{which}_y")
