"""Parts of pictures at another size, in linear light, and the cameras that see them."""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
from jaxtyping import UInt8

from primdiffusion.formats.camera_rig import View
from primdiffusion.raster.textures import BYTE_OF_LINEAR, LINEAR_OF_BYTE


@dataclasses.dataclass(frozen=True)
class Window:
    """A rectangle of a picture, in pixels from its upper left corner."""

    left: float
    top: float
    width: float
    height: float


def whole(view: View) -> Window:
    """All of a view's picture."""
    return Window(0, 0, view.width, view.height)


def through(view: View, window: Window, size: int) -> View:
    """The camera whose picture of `size` squared pixels is the window."""
    change = np.array(
        [
            [size / window.width, 0, -window.left * size / window.width],
            [0, size / window.height, -window.top * size / window.height],
            [0, 0, 1],
        ]
    )
    return dataclasses.replace(view, intrinsics=change @ view.intrinsics, width=size, height=size)


def resample(rgba: UInt8[np.ndarray, "H W 4"], window: Window, size: int) -> UInt8[np.ndarray, "size size 4"]:
    """The window at `size` squared pixels: each is the mean of what it covers, colours averaged in linear light.

    Colours are over black, so they average as they are; outside of the picture there is nothing.
    """
    if window == Window(0, 0, size, size) and rgba.shape[:2] == (size, size):
        return rgba
    out = np.empty((size, size, 4), np.uint8)
    _resample(rgba, window.left, window.top, window.width / size, window.height / size, LINEAR_OF_BYTE,
              BYTE_OF_LINEAR, out)  # fmt: skip
    return out


@numba.njit(cache=True, nogil=True)
def _resample(rgba, left, top, across, down, linear_of_byte, byte_of_linear, out):
    height, width = rgba.shape[:2]
    scale = np.float32(1 / (across * down))
    for row in range(out.shape[0]):
        y0, y1 = top + row * down, top + (row + 1) * down
        for column in range(out.shape[1]):
            x0, x1 = left + column * across, left + (column + 1) * across
            red, green, blue, alpha = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            for y in range(max(int(np.floor(y0)), 0), min(int(np.ceil(y1)), height)):
                share_y = min(y1, y + 1.0) - max(y0, float(y))
                for x in range(max(int(np.floor(x0)), 0), min(int(np.ceil(x1)), width)):
                    share = np.float32(share_y * (min(x1, x + 1.0) - max(x0, float(x))))
                    red += share * linear_of_byte[rgba[y, x, 0]]
                    green += share * linear_of_byte[rgba[y, x, 1]]
                    blue += share * linear_of_byte[rgba[y, x, 2]]
                    alpha += share * np.float32(rgba[y, x, 3])
            top_value = np.float32(65535)
            out[row, column, 0] = byte_of_linear[int(min(red * scale, np.float32(1)) * top_value + np.float32(0.5))]
            out[row, column, 1] = byte_of_linear[int(min(green * scale, np.float32(1)) * top_value + np.float32(0.5))]
            out[row, column, 2] = byte_of_linear[int(min(blue * scale, np.float32(1)) * top_value + np.float32(0.5))]
            out[row, column, 3] = int(min(alpha * scale, np.float32(255)) + np.float32(0.5))
