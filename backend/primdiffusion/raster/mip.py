"""Textures at several sizes, to read the mean colour of a footprint larger than a texel."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, UInt8

from primdiffusion.raster.rasterise import LINEAR_OF_BYTE
from primdiffusion.raster.triangle_soup import ALPHA_TEST


def pyramid(texture: UInt8[np.ndarray, "H W 4"], levels: int) -> list[Float32[np.ndarray, "h w 4"]]:
    """The texture and its `levels` - 1 halvings: linear colour times weight, and weight.

    A texel weighs 1 if it passes the alpha test and 0 otherwise, so that what is cut out tints nothing. Stops early at
    a side of one texel.
    """
    weight = (texture[..., 3:] >= ALPHA_TEST).astype(np.float32)
    level = np.concatenate([LINEAR_OF_BYTE[texture[..., :3]] * weight, weight], -1)
    result = [level]
    while len(result) < levels and min(level.shape[:2]) > 1:
        height, width = (side // 2 * 2 for side in level.shape[:2])
        level = level[:height, :width].reshape(height // 2, 2, width // 2, 2, 4).mean((1, 3))
        result.append(level)
    return result
