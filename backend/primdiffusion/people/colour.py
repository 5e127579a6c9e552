"""Conversions between sRGB bytes, linear RGB and CIE Lab (D65; IEC 61966-2-1 and CIE 15).

All in float64: processors differ in the last bit of sums and powers, which would change bytes rounded from float32.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

from primdiffusion.geometry.srgb import decode_srgb, encode_srgb

XYZ_FROM_RGB = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]],
    np.float64,
)
RGB_FROM_XYZ = np.linalg.inv(XYZ_FROM_RGB.astype(np.float64)).astype(np.float64)
WHITE = np.array([0.95047, 1.0, 1.08883], np.float64)
EPSILON, SLOPE = np.float64(216 / 24389), np.float64(24389 / 27)

_DECODED = decode_srgb(np.arange(256, dtype=np.float64) / 255)
_ENCODED = np.rint(encode_srgb(np.linspace(0, 1, 4096, dtype=np.float64)) * 255).astype(np.uint8)


def lab_from_bytes(encoded: UInt8[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
    """Convert sRGB-encoded bytes to float64 Lab; lightness runs from 0 to 100."""
    xyz = _DECODED[encoded] @ (XYZ_FROM_RGB / WHITE[:, None]).T
    f = np.where(xyz > EPSILON, np.cbrt(xyz), (SLOPE * xyz + 16) / 116)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


def bytes_from_lab(lab: Float[np.ndarray, "*b 3"]) -> UInt8[np.ndarray, "*b 3"]:
    """Convert Lab to the nearest sRGB-encoded bytes; colours outside the gamut are clipped."""
    fy = (lab[..., 0] + 16) / 116
    f = np.stack([fy + lab[..., 1] / 500, fy, fy - lab[..., 2] / 200], axis=-1).astype(np.float64)
    xyz = np.where(f**3 > EPSILON, f**3, (116 * f - 16) / SLOPE)
    return bytes_from_linear(xyz @ (RGB_FROM_XYZ * WHITE).T)


def bytes_from_linear(linear: Float[np.ndarray, "*b 3"]) -> UInt8[np.ndarray, "*b 3"]:
    """Convert linear values in [0, 1] to sRGB-encoded bytes, off by at most one (a table of 4096 entries)."""
    return _ENCODED[np.clip(linear * 4095 + 0.5, 0, 4095).astype(np.int16)]


def linear_from_bytes(encoded: UInt8[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
    """Convert sRGB-encoded bytes to float64 linear values."""
    return _DECODED[encoded]


def luminance(encoded: UInt8[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Compute the relative luminance (linear) of sRGB-encoded bytes."""
    return _DECODED[encoded] @ XYZ_FROM_RGB[1]
