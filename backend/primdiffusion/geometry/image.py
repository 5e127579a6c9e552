"""Images in memory, and the sRGB transfer function (IEC 61966-2-1): files hold encoded values, records linear ones."""

from __future__ import annotations

import dataclasses
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray
from numpy.typing import NDArray
from torch import Tensor


@dataclasses.dataclass(frozen=True, eq=False)
class Image:
    """Image of a camera, on black: linear RGB, opacity and depth, and, where they are drawn, normals and parts."""

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


Colours = TypeVar("Colours", Tensor, NDArray[np.floating])


def encode_srgb(linear: Colours) -> Colours:
    """Linear values in [0, 1] to sRGB-encoded ones of the same type, shape and dtype; differentiable for tensors.

    Values outside [0, 1] are not clamped; negative ones stay on the curve's linear piece.
    """
    if isinstance(linear, Tensor):
        # Clamp before the power: its slope at 0 is infinite, so torch.where alone would produce NaN gradients.
        power = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
        return torch.where(linear <= 0.0031308, 12.92 * linear, power)
    power = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, power).astype(linear.dtype, copy=False)


def decode_srgb(encoded: Colours) -> Colours:
    """The inverse of `encode_srgb`."""
    # The same knee as the encoder's, 12.92 * 0.0031308 instead of 0.04045, so that the pair inverts exactly.
    knee = 12.92 * 0.0031308
    if isinstance(encoded, Tensor):
        power = ((encoded.clamp_min(knee) + 0.055) / 1.055) ** 2.4
        return torch.where(encoded <= knee, encoded / 12.92, power)
    power = ((np.maximum(encoded, knee) + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= knee, encoded / 12.92, power).astype(encoded.dtype, copy=False)


def to_bytes(values: Float[Tensor, "*shape"]) -> UInt8[Tensor, "*shape"]:
    """Values in 0 ... 1 as bytes, rounded; those beyond are clamped."""
    return (values.detach().clamp(0, 1) * 255).round().to(torch.uint8)
