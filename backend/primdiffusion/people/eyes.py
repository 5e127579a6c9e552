"""Eye textures in natural colours: the pack's irises with their hue replaced."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import UInt8

from primdiffusion.people.assets import Assets
from primdiffusion.people.colour import bytes_from_lab, lab_from_bytes

SIZE = 256
FOLDER = "eyes/materials"
WHITE_CHROMA, IRIS_CHROMA = 9.0, 20.0
"""Lab chroma below which a texel is sclera, and above which it is iris."""


@dataclasses.dataclass(frozen=True)
class Iris:
    """Recolouring of one of the pack's iris images."""

    share: float
    """Relative frequency with light skin."""
    hue: tuple[float, float]
    """Median a and b (Lab) of the iris."""
    lightness: float
    """Factor on lightness."""
    dark: bool = False
    """Whether it is equally frequent with dark skin."""


IRISES = {
    "brown": Iris(0.4, (8.0, 13.0), 1.15, dark=True),
    "brownlight": Iris(0.22, (6.0, 20.0), 0.75, dark=True),
    "blue": Iris(0.1, (-3.0, -15.0), 1.0),
    "lightblue": Iris(0.07, (-4.0, -15.0), 0.8),
    "green": Iris(0.07, (-8.0, 13.0), 0.9),
    "grey": Iris(0.07, (-1.0, -3.0), 0.85),
    "bluegreen": Iris(0.04, (-8.0, 0.0), 0.75),
    "ice": Iris(0.03, (-3.0, -7.0), 0.8),
}


def draw_eyes(assets: Assets, tone: float, draws: np.random.Generator) -> str:
    """Draw the name of an iris; dark skin (tone near 1) comes with brown eyes."""
    available = {name: iris for name, iris in IRISES.items() if assets.has_picture(picture_of(name))} or IRISES
    shares = np.array([iris.share * (1 if iris.dark else (1 - tone) ** 2) for iris in available.values()])
    return list(available)[draws.choice(len(available), p=shares / shares.sum())]


def picture_of(name: str) -> str:
    """Path of an iris image, without extension."""
    return f"{FOLDER}/{name}_eye"


def eye_texture(assets: Assets, name: str) -> UInt8[np.ndarray, "H W 4"]:
    """Make the texture of both eyes."""
    iris, texture = IRISES[name], assets.picture(picture_of(name), SIZE).copy()
    lab = lab_from_bytes(texture[..., :3])
    chroma = np.hypot(lab[..., 1], lab[..., 2])
    share = np.clip((chroma - WHITE_CHROMA) / (IRIS_CHROMA - WHITE_CHROMA), 0, 1)[..., None]
    middle = np.median(chroma[chroma > IRIS_CHROMA]) if (chroma > IRIS_CHROMA).any() else IRIS_CHROMA
    hue = np.clip(chroma / middle, 0, 1.3)[..., None] * np.array(iris.hue)
    coloured = np.concatenate([lab[..., :1] * iris.lightness, hue], axis=-1)
    texture[..., :3] = bytes_from_lab(share * coloured + (1 - share) * lab)
    return texture
