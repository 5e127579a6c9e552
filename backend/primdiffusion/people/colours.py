"""Colour conversions (sRGB bytes, linear RGB, CIE Lab D65; IEC 61966-2-1 and CIE 15) and random colours of people.

All in float64: processors differ in the last bit of sums and powers, which would change bytes rounded from float32.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

from primdiffusion.geometry.image import decode_srgb, encode_srgb

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


def luminance(encoded: UInt8[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Compute the relative luminance (linear) of sRGB-encoded bytes."""
    return _DECODED[encoded] @ XYZ_FROM_RGB[1]


# sRGB, hexadecimal. Repeats are weights.
CLOTHES: dict[str, str] = {
    "top": "f2f2ee f2f2ee f2f2ee e8e3d5 c4c6c8 8d9196 4a4d52 4a4d52 22242a 22242a 22242a 1f2c4d 1f2c4d 3b4a6b 5f7fa8 "
    "8db6d9 3f5a47 6b7a45 7a2637 b89f7d 6b4c38 c9a13b b23a3a d79aa8 2e8b8b",
    "denim": "2a3a55 2f4a74 47658f 47658f 6d8bb5 8ba5c4 23252a 55595f b09a73 5b4636 55583c d5d0c2",
    "trousers": "23252a 2e3138 1f2a40 4a4d52 6a6d70 5b4636 8b7a5c 3a3f33",
    "tights": "1c1d21 23252a 2a2f45 3d3f45 4a2f3f 2f4a4a 5a5d63",
    "skirt": "22242a 22242a 3b3f46 1f2c4d 6a6d70 5b3a3a 7a2637 8b7a5c 3f4a3a b89f7d",
    "jacket": "3f4a3a 55583c 5b4636 2e3138 1f2c4d 1f2c4d 8b7a5c 6b2f2f 6a6d70 22242a 22242a 8a6a4a",
    "suit": "1b1c20 26282e 1f2a40 2c3a5a 4a4d52 5b4a3e 77787a a89a80",
    "overall": "2f4a74 47658f 6d8bb5 55583c 8b7a5c 6b3f2a 2e3138 3f6a5a",
    "shoe": "1c1a19 2b2725 4a2f20 6b4328 8b5a33 a5764a d8d4cb f0eeea 5a5d63 1f2c4d 7a2a2a",
    "sock": "eeeeea d5d5d0 8d9196 2a2c30 1f2c4d",
    "hat": "1c1c1e 4a3f36 6a5a48 8d8a84 b7a88c 26304a d9d3c4",
    "detail": "9a9a94 c0a050 3a3a3c 2a2420",
    "shirt": "f2f2ee f2f2ee dfe6ee c9d8e8 e6d8dc 22242a 3f5f8f 7a2637 6b7a45 8d9196",
}
SOBER = ("trousers", "tights", "skirt", "suit", "shoe", "sock", "hat")
HAIR: dict[str, str] = {
    "black": "292523",
    "darkbrown": "2a1c14",
    "brown": "452d1e",
    "lightbrown": "6e4b30",
    "auburn": "5e2a18",
    "red": "8a4423",
    "darkblond": "8f6d42",
    "blond": "bf9a63",
    "grey": "8a8783",
    "white": "cfccc6",
}
VIVID = 24.0
"""Lab chroma above which a colour is vivid."""
GREY_SHARE = {"young": (0.0, 0.0), "middleage": (0.12, 0.02), "old": (0.7, 0.5)}
"""Shares of grey and white hair beside all other colours together."""
CLOTHES_SPREAD, SOBER_SPREAD, HAIR_SPREAD = (5.0, 4.0, 4.0), (4.0, 1.5, 2.0), (2.5, 0.7, 1.2)
"""Standard deviations of colours around their palette entries, Lab."""


def garment_colour(kind: str, draws: np.random.Generator) -> Float[np.ndarray, "3"]:
    """Draw a linear colour for a kind of garment."""
    codes = CLOTHES[kind].split()
    spread = SOBER_SPREAD if kind in SOBER else CLOTHES_SPREAD
    return _near(codes[draws.integers(len(codes))], draws, spread)


def is_vivid(colour: Float[np.ndarray, "3"]) -> bool:
    """Whether a linear colour is one of the few of a person's clothes that catch the eye."""
    return bool(np.hypot(*lab_from_bytes(bytes_from_linear(colour))[1:]) > VIVID)


def contrasting(colour: Float[np.ndarray, "3"], kind: str, draws: np.random.Generator) -> Float[np.ndarray, "3"]:
    """Draw four colours for a kind of garment and return the one farthest from `colour`."""
    options = [garment_colour(kind, draws) for _ in range(4)]
    return max(options, key=lambda option: float(np.abs(np.sqrt(option) - np.sqrt(colour)).sum()))


def hair_colour(tone: float, age: str, draws: np.random.Generator) -> tuple[str, Float[np.ndarray, "3"]]:
    """Draw a hair colour's name and linear value; dark skin (tone near 1) comes with dark hair, age with grey."""
    light = (0.16, 0.2, 0.2, 0.13, 0.06, 0.05, 0.08, 0.09, 0.02, 0.01)
    dark = (0.62, 0.22, 0.08, 0.01, 0.01, 0.0, 0.0, 0.01, 0.04, 0.01)
    darkness = min(1.0, 1.6 * tone)
    share = np.array(light) * (1 - darkness) + np.array(dark) * darkness
    share[-2:] = GREY_SHARE[age]
    name = list(HAIR)[draws.choice(len(HAIR), p=share / share.sum())]
    return name, _near(HAIR[name], draws, HAIR_SPREAD)


def _near(code: str, draws: np.random.Generator, spread: tuple[float, float, float]) -> Float[np.ndarray, "3"]:
    """Draw a linear colour around a hexadecimal one."""
    lab = lab_from_bytes(np.frombuffer(bytes.fromhex(code), np.uint8))
    moved = lab + draws.normal(0, spread).astype(np.float64)
    moved[0] = np.clip(moved[0], 3, 97)
    return _DECODED[bytes_from_lab(moved)].astype(np.float64)
