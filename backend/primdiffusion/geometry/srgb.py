"""The sRGB transfer function (IEC 61966-2-1): files hold encoded values, records hold linear ones."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

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
