"""A picture that stands upright in a 3D view and turns about the vertical axis towards its camera."""

from __future__ import annotations

import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from numpy.typing import NDArray

from .composite import restore

HEIGHT_M = 1.75
"""Of the figure in the picture."""
_SOLID = 0.5
"""Alpha of the figure, without its rim."""
_LEAST = 0.5
"""Of the picture's height; a lower figure is not all of it."""
_FROM_ABOVE = 1e-3
_TEXTURE_CORNERS = ((0, 0), (1, 0), (0, 1), (1, 1))


def corners(place: NDArray, to_view: NDArray, figure: tuple[float, float], aspect: float = 1.0) -> NDArray[np.float64]:
    """Corners [4, 3] in Blender's world: bottom left, bottom right, top left, top right.

    The figure reaches from `place` [3] up by HEIGHT_M; its lower and upper end are `figure`, as fractions of the
    picture's height. `to_view` [4, 4] is the view's matrix; seen from above, the picture shows only its edge. `aspect`
    is width by height.
    """
    low, high = figure
    height = HEIGHT_M / (high - low)
    right = np.cross([0.0, 0.0, 1.0], to_view[2, :3])
    if np.linalg.norm(right) < _FROM_ABOVE:
        right = to_view[0, :3] * [1.0, 1.0, 0.0]
    side = right / np.linalg.norm(right) * height * aspect / 2
    up = np.array([0.0, 0.0, height])
    bottom = np.asarray(place, np.float64) - low * up
    return np.array([bottom - side, bottom + side, bottom - side + up, bottom + side + up])


def share_in_view(places: NDArray, to_window: NDArray) -> float:
    """How much of a picture with these corners [4, 3] a region shows, 0 to 1; 0 where it reaches behind the camera.

    `to_window` [4, 4] is the region's perspective matrix.
    """
    clip = np.concatenate([places, np.ones((len(places), 1))], 1) @ to_window.T
    if (clip[:, 3] <= 0).any():
        return 0.0
    points = clip[:, :2] / clip[:, 3:]
    low, high = points.min(0), points.max(0)
    within = np.clip(high, -1, 1) - np.clip(low, -1, 1)
    return float(np.prod(within / np.maximum(high - low, 1e-9)))


def figure_of(alpha: NDArray) -> tuple[float, float]:
    """Lower and upper end of the figure in a picture's alpha [h, w], bottom row first, as fractions of its height; the
    whole picture where little is opaque."""
    rows = np.flatnonzero((alpha >= _SOLID).any(1))
    if len(rows) == 0 or rows[-1] + 1 - rows[0] < _LEAST * len(alpha):
        return 0.0, 1.0
    return rows[0] / len(alpha), (rows[-1] + 1) / len(alpha)


def texture_of(picture: NDArray[np.float32]) -> gpu.types.GPUTexture:
    """A texture of RGBA [h, w, 4], bottom row first."""
    values = np.ascontiguousarray(picture, np.float32).ravel()
    data = gpu.types.Buffer("FLOAT", values.size, values)
    return gpu.types.GPUTexture((picture.shape[1], picture.shape[0]), format="RGBA16F", data=data)


def draw(texture: gpu.types.GPUTexture, places: NDArray) -> None:
    """Draw a picture at its corners [4, 3], behind what is before it; for handlers of the kind POST_VIEW.

    Its colours are premultiplied and encoded as sRGB, which the built-in shader expects.
    """
    shader = gpu.shader.from_builtin("IMAGE")
    gpu.state.blend_set("ALPHA_PREMULT")
    gpu.state.depth_test_set("LESS_EQUAL")
    gpu.state.depth_mask_set(False)
    shader.bind()
    shader.uniform_sampler("image", texture)
    points = {"pos": np.ascontiguousarray(places, np.float32), "texCoord": _TEXTURE_CORNERS}
    batch_for_shader(shader, "TRI_STRIP", points).draw(shader)
    restore()
