"""From Blender's cameras, matrices and render border to the backend's pinhole camera; which engine draws a 3D view."""

from __future__ import annotations

import dataclasses

import bpy
import numpy as np
from numpy.typing import NDArray

from ..scene.convention import BLENDER_FROM_BACKEND

ENGINE = "PRIMDIFFUSION"
WORKBENCH = "BLENDER_WORKBENCH"
EEVEE = "BLENDER_EEVEE"
PARALLEL_M = 2000.0
"""An orthographic view is drawn by a pinhole this far from the human: over a body's thickness its scale then varies by
a ten-thousandth. Farther away, float32 positions along a ray would be coarser than a tenth of a millimetre."""
NO_SURFACE_M = 1e10
"""Depth where a ray meets nothing, as Cycles writes it."""
_FLIP = np.diag([1.0, -1.0, -1.0])
"""Blender's cameras look along -z with y up, OpenCV's along z with y down."""


@dataclasses.dataclass(frozen=True)
class PinholeView:
    """The camera of a whole picture, also where only a part is drawn; OpenCV convention, backend axes, metres."""

    intrinsics: NDArray[np.float64]
    """[3, 3], pixels; origin at the top left, pixel centres at +0.5."""
    world_to_camera: NDArray[np.float64]
    """[3, 4]."""
    clip: tuple[float, float]
    """Metres along the optical axis."""
    width: int
    height: int
    depth_offset: float = 0.0
    """Distance of the pinhole behind the camera that it replaces, to be subtracted from depths."""

    def scaled(self, width: int, height: int) -> PinholeView:
        """The same view in another resolution."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return dataclasses.replace(self, intrinsics=scale @ self.intrinsics, width=width, height=height)

    def params(self) -> dict[str, object]:
        """Parameters of the child's `draw`."""
        return {
            "intrinsics": self.intrinsics.tolist(),
            "world_to_camera": self.world_to_camera.tolist(),
            "clip": list(self.clip),
            "width": self.width,
            "height": self.height,
        }


def view_from_matrices(
    projection: NDArray,
    view: NDArray,
    clip: tuple[float, float],
    size: tuple[int, int],
    subject: NDArray,
) -> PinholeView:
    """The pinhole that sees what an OpenGL projection [4, 4] and world-to-view matrix [4, 4], z up, show.

    A perspective projection has -1 in its last row and its principal point in the third column; a parallel one is taken
    by a pinhole PARALLEL_M in front of `subject` [3] (world, z up), at whose distance the picture's scale is exact.
    `clip` is along the optical axis in metres; `size` is width and height in pixels.
    """
    projection, view = np.asarray(projection, np.float64), np.asarray(view, np.float64)
    width, height = size
    rotation = _FLIP @ view[:3, :3]
    translation = _FLIP @ view[:3, 3]
    half = np.array([width, height]) / 2
    scale = np.array([projection[0, 0], projection[1, 1]]) * half
    if projection[3, 2] != 0:
        centre = half * (1 + np.array([-projection[0, 2], projection[1, 2]]))
        offset = 0.0
    else:
        centre = half * (1 + np.array([projection[0, 3], -projection[1, 3]]))
        scale = scale * PARALLEL_M
        offset = PARALLEL_M - float(rotation[2] @ subject + translation[2])
        translation = translation + np.array([0.0, 0.0, offset])
        clip = (max(clip[0] + offset, 0.0), clip[1] + offset)
    intrinsics = np.array([[scale[0], 0, centre[0]], [0, scale[1], centre[1]], [0, 0, 1]])
    world_to_camera = np.concatenate([rotation @ BLENDER_FROM_BACKEND, translation[:, None]], 1)
    return PinholeView(intrinsics, world_to_camera, clip, width, height, offset)


def region_view(context: bpy.types.Context, subject: NDArray) -> PinholeView:
    """What a region of a 3D view shows; `subject` as for `view_from_matrices`."""
    region, around = context.region, context.region_data
    projection, to_view = (np.array(matrix, np.float64) for matrix in (around.window_matrix, around.view_matrix))
    return view_from_matrices(projection, to_view, clip_of(projection), (region.width, region.height), subject)


def clip_of(projection: NDArray) -> tuple[float, float]:
    """Start and end of what an OpenGL projection [4, 4] shows, along the optical axis."""
    if projection[3, 2] == 0:
        return (projection[2, 3] + 1) / projection[2, 2], (projection[2, 3] - 1) / projection[2, 2]
    return projection[2, 3] / (projection[2, 2] - 1), projection[2, 3] / min(projection[2, 2] + 1, -1e-9)


def opengl_projection(view: PinholeView) -> NDArray[np.float64]:
    """The matrix [4, 4] from the world, y up, to OpenGL's clip space."""
    near = max(view.clip[0], 1e-4)
    far = max(view.clip[1], near * 1.001)
    half = np.array([view.width, view.height]) / 2
    focal, middle = np.diag(view.intrinsics)[:2] / half, view.intrinsics[:2, 2] / half - 1
    projection = np.array(
        [
            [focal[0], 0, middle[0], 0],
            [0, -focal[1], -middle[1], 0],
            [0, 0, (far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, 1, 0],
        ]
    )
    return projection @ np.concatenate([view.world_to_camera, [[0, 0, 0, 1]]])


def without_scale(matrix: NDArray) -> NDArray[np.float64]:
    """An object's world matrix [4, 4] with axes of unit length: a camera's own scale does not count in Blender."""
    matrix = np.array(matrix, np.float64)
    matrix[:3, :3] /= np.maximum(np.linalg.norm(matrix[:3, :3], axis=0), 1e-12)
    return matrix


def blender_depth(depth: NDArray[np.float32], view: PinholeView) -> NDArray[np.float32]:
    """The child's depths as Blender defines them: from the camera's plane, NO_SURFACE_M where a ray meets nothing."""
    if view.depth_offset == 0.0:
        return depth
    return np.where(depth < NO_SURFACE_M / 2, depth - np.float32(view.depth_offset), np.float32(NO_SURFACE_M))


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


def view_engine(engine: str, shading: str) -> str:
    """The engine that draws a 3D view with this shading, in a scene with this render engine."""
    return {"RENDERED": engine, "MATERIAL": EEVEE}.get(shading, WORKBENCH)


def renders_volumes(engine: str) -> bool:
    """Whether an engine lights volumes. Engines declare that as Blender's own do: their name is in COMPAT_ENGINES of
    the panel of a volume's file (in Blender 5.0 to 5.3 Cycles, EEVEE and Hydra Storm). Workbench declares it too, but
    draws a grey fog."""
    panel = getattr(bpy.types, "DATA_PT_volume_file", None)
    return engine in getattr(panel, "COMPAT_ENGINES", ()) and engine not in (WORKBENCH, ENGINE)
