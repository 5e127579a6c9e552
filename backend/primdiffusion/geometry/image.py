"""Drawn images in memory."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Image:
    """What a camera sees, on black: linear RGB, opacity and depth, and, where they are drawn, normals and parts."""

    rgb: Float32[ndarray, "h w 3"]
    """Linear, premultiplied by `alpha`."""
    alpha: Float32[ndarray, "h w"]
    """Opacity, or the share of the pixel's samples that hit a surface."""
    depth: Float32[ndarray, "h w"]
    """Metres along the optical axis; inf for background."""
    normal: Float32[ndarray, "h w 3"] | None = None
    """World space, unit, towards the camera; 0 for background."""
    part: UInt8[ndarray, "h w"] | None = None
    """1 + the joint that moves the surface most; 0 for background."""

    @classmethod
    def blank(cls, width: int, height: int) -> Image:
        """An empty image without normals and parts."""
        size = (height, width)
        return cls(np.zeros((*size, 3), np.float32), np.zeros(size, np.float32), np.full(size, np.inf, np.float32))

    @property
    def rgba(self) -> Float32[ndarray, "h w 4"]:
        """Colours and opacity; a copy."""
        return np.concatenate([self.rgb, self.alpha[..., None]], axis=-1)
