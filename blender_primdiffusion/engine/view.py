"""From Blender's view and projection matrices to the backend's pinhole camera. numpy only."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ..scene.convention import BLENDER_FROM_BACKEND

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

    def part(self, region: tuple[int, int, int, int]) -> PinholeView:
        """The view of a part [x, y, width, height], pixels from the left and the bottom."""
        x, y, width, height = region
        intrinsics = self.intrinsics.copy()
        intrinsics[:2, 2] -= x, self.height - y - height
        return dataclasses.replace(self, intrinsics=intrinsics, width=width, height=height)

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
