"""Textures of skin, eyes, hair, brows and lashes in natural colours.

Skin is interpolated between the few textures of the pack. Tone 0 is a light texture, tone 1 has the local mean colour
(Lab) of a dark one. Local means are used because palms, soles and scalp differ less between light and dark skin than
the rest. Detail finer than the local mean is the base texture's, so that female skins can be dark although the pack's
dark textures are male. Eyes are the pack's irises with their hue replaced; hair is a colour times shading, from the
pack's texture or procedural.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image
from scipy.ndimage import binary_dilation, gaussian_filter

from primdiffusion.people.assets import Assets
from primdiffusion.people.colours import bytes_from_lab, bytes_from_linear, lab_from_bytes, luminance
from primdiffusion.people.fitting import uv_islands
from primdiffusion.people.wardrobe import Sex, hair_path, stream
from primdiffusion.raster.uv_atlas import TexelMap, texel_map

SKIN_SIZE = 1024
COARSE = 256
"""Resolution of the local mean, texels."""
SPREAD = 6.0
"""Standard deviation of the local mean's window, texels of COARSE."""
BROAD_SPREAD, EVENED = 16.0, (0.3, 0.6, 0.6)
"""Window (texels of COARSE) and strength (L, a, b) with which limbs are shifted towards the skin's median colour."""
SKIN_FOLDER = "skins/textures"
LEFT_OUT = ("suit", "toon")


@dataclasses.dataclass(frozen=True)
class SkinColours:
    """A skin: two textures, a tone between them, and a colour shift."""

    base: str
    """Texture that provides the detail."""
    other: str
    """Texture of the opposite tone that provides the other local mean."""
    tone: float
    """0 light to 1 dark."""
    shift: tuple[float, float, float]
    """Offset in Lab."""

    @property
    def age(self) -> str:
        """Young, middleage or old, from the name of the base texture."""
        return self.base.rsplit("/", 1)[-1].split("_", 1)[0]


def draw_skin(assets: Assets, sex: Sex, draws: np.random.Generator) -> SkinColours:
    """Draw a skin: uniform tone; detail from a texture of the sex and, if available, of the tone.

    Raises:
        FileNotFoundError: there are no light skins of this sex or no dark skins.
    """
    light = _textures(assets, f"lightskinned_{sex}")
    dark = _textures(assets, f"darkskinned_{sex}")
    any_dark = dark or _textures(assets, "darkskinned")
    if not light or not any_dark:
        raise FileNotFoundError(
            f"no light {sex} skins or no dark skins in {assets.root / SKIN_FOLDER}: fetch the whole asset pack"
        )
    tone = float(draws.random())
    light_pick, dark_pick = draws.integers(1 << 30, size=2)
    light_name, dark_name = light[light_pick % len(light)], any_dark[dark_pick % len(any_dark)]
    base, other = (dark_name, light_name) if dark and tone > 0.55 else (light_name, dark_name)
    shift = tuple(float(value) for value in draws.normal(0, (2.5, 1.2, 2.0)))
    return SkinColours(base, other, tone, (shift[0], shift[1], shift[2]))


def skin_texture(assets: Assets, skin: SkinColours) -> UInt8[np.ndarray, "H W 4"]:
    """Make the texture of a skin."""
    distance = skin.tone if "lightskinned" in skin.base else 1 - skin.tone
    means = _local_mean(assets, skin.other) - _local_mean(assets, skin.base)
    move = distance * means + np.array(skin.shift)
    broad = gaussian_filter(_local_mean(assets, skin.base) + move, (BROAD_SPREAD, BROAD_SPREAD, 0))
    move -= np.array(EVENED) * (broad - np.median(broad, axis=(0, 1)))
    lab = _lab(assets, skin.base).astype(np.float64)
    height, width = lab.shape[:2]
    for channel in range(3):
        coarse = Image.fromarray(move[..., channel].astype(np.float32))
        lab[..., channel] += np.asarray(coarse.resize((width, height), Image.Resampling.BILINEAR))
    texture = np.full((height, width, 4), 255, np.uint8)
    texture[..., :3] = bytes_from_lab(lab)
    return texture


def _textures(assets: Assets, word: str) -> tuple[str, ...]:
    """Skins whose file name contains a word, without painted clothes and cartoons."""
    return tuple(
        name for name in assets.pictures(SKIN_FOLDER, f"_{word}") if not any(left_out in name for left_out in LEFT_OUT)
    )


@functools.lru_cache(maxsize=32)
def _lab(assets: Assets, name: str) -> np.ndarray:
    """A skin texture in Lab, half precision."""
    return lab_from_bytes(assets.picture(name, SKIN_SIZE)[..., :3]).astype(np.float16)


@functools.lru_cache(maxsize=32)
def _local_mean(assets: Assets, name: str) -> Float[np.ndarray, "COARSE COARSE 3"]:
    """Local mean colour of a skin texture, Lab."""
    lab = lab_from_bytes(assets.picture(name, COARSE)[..., :3])
    return gaussian_filter(lab, (SPREAD, SPREAD, 0))


EYE_SIZE = 256
EYE_FOLDER = "eyes/materials"
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
    return f"{EYE_FOLDER}/{name}_eye"


def eye_texture(assets: Assets, name: str) -> UInt8[np.ndarray, "H W 4"]:
    """Make the texture of both eyes."""
    iris, texture = IRISES[name], assets.picture(picture_of(name), EYE_SIZE).copy()
    lab = lab_from_bytes(texture[..., :3])
    chroma = np.hypot(lab[..., 1], lab[..., 2])
    share = np.clip((chroma - WHITE_CHROMA) / (IRIS_CHROMA - WHITE_CHROMA), 0, 1)[..., None]
    middle = np.median(chroma[chroma > IRIS_CHROMA]) if (chroma > IRIS_CHROMA).any() else IRIS_CHROMA
    hue = np.clip(chroma / middle, 0, 1.3)[..., None] * np.array(iris.hue)
    coloured = np.concatenate([lab[..., :1] * iris.lightness, hue], axis=-1)
    texture[..., :3] = bytes_from_lab(share * coloured + (1 - share) * lab)
    return texture


HAIR_SIZE = 512
CURLY = ("afro01",)
OPAQUE = 128
"""Alpha from which a texel is opaque, as in the rasteriser's alpha test."""


@dataclasses.dataclass(frozen=True, eq=False)
class Strands:
    """The texture of a hair mesh without colour."""

    shade: Float[np.ndarray, "H W"]
    """Shading, with median 1."""
    alpha: UInt8[np.ndarray, "H W"]


@functools.lru_cache(maxsize=16)
def strands(assets: Assets, name: str) -> Strands:
    """Get the strands of a hair mesh: from its texture, or procedural if the pack has none."""
    picture = f"{hair_path(name)}_diffuse"
    if not assets.has_picture(picture):
        corner_uv = assets.proxy(hair_path(name))[1].corner_uv
        texels = texel_map(corner_uv, HAIR_SIZE)
        return _curls(texels, uv_islands(corner_uv)) if name in CURLY else _straight(texels, name)
    texture = assets.picture(picture, HAIR_SIZE)
    light = luminance(texture[..., :3])
    middle = np.median(light[texture[..., 3] >= OPAQUE])
    return Strands(np.clip((light + 0.01) / (middle + 0.01), 0.2, 2.5) ** 0.7, texture[..., 3])


def coloured_strands(hair: Strands, colour: Float[np.ndarray, "3"]) -> UInt8[np.ndarray, "H W 4"]:
    """Colour strands with one linear colour."""
    rgb = bytes_from_linear(np.clip(hair.shade[..., None] * colour.astype(np.float64), 0, 1))
    return np.concatenate([rgb, hair.alpha[..., None]], axis=-1)


def tint_cutout(picture: UInt8[np.ndarray, "H W 4"], colour: Float[np.ndarray, "3"]) -> UInt8[np.ndarray, "H W 4"]:
    """Colour brows or lashes with one linear colour; alpha is increased so that they pass the alpha test."""
    texture = np.empty_like(picture)
    texture[..., :3] = bytes_from_linear(colour.astype(np.float64))
    texture[..., 3] = np.minimum(picture[..., 3].astype(np.int32) * 3 // 2, 255).astype(np.uint8)
    return texture


def _straight(texels: TexelMap, name: str) -> Strands:
    """Procedural strands along the texture's columns, with ragged ends at the bottom of each island."""
    draws = stream(0, f"strands of {name}")
    noise = draws.standard_normal((3, HAIR_SIZE, HAIR_SIZE)).astype(np.float64)
    shade = sum(
        share * _unit(gaussian_filter(layer, spread))
        for layer, share, spread in zip(noise, (0.8, 1.0, 0.8), ((60, 0.7), (80, 1.6), (100, 5)), strict=True)
    )
    below = np.zeros((HAIR_SIZE, HAIR_SIZE), np.float64)
    above = np.zeros((HAIR_SIZE, HAIR_SIZE), np.float64)
    for row in range(HAIR_SIZE - 2, -1, -1):
        below[row] = np.where(texels.inside[row], below[row + 1] + 1, 0)
    for row in range(1, HAIR_SIZE):
        above[row] = np.where(texels.inside[row], above[row - 1] + 1, 0)
    reach = np.abs(_unit(gaussian_filter(draws.standard_normal((HAIR_SIZE, HAIR_SIZE)).astype(np.float64), (40, 0.8))))
    ragged = below > 0.06 * (below + above) * reach
    # Dilated sideways across island borders, or gaps would open between adjacent sheets.
    opaque = binary_dilation(ragged, np.ones((1, 5), bool))
    return Strands(np.exp(0.22 * shade).astype(np.float64), np.where(opaque, 255, 0).astype(np.uint8))


def _curls(texels: TexelMap, island: Int[np.ndarray, " F"]) -> Strands:
    """Procedural isotropic curls: the two largest islands, a cap, are opaque; the tufts around it have gaps."""
    draws = stream(0, "curls")
    noise = draws.standard_normal((2, HAIR_SIZE, HAIR_SIZE)).astype(np.float64)
    curls, tufts = _unit(gaussian_filter(noise[0], 2.0)), _unit(gaussian_filter(noise[1], 7.0))
    edge = gaussian_filter(texels.inside.astype(np.float64), 5)
    opaque = (island < 2)[texels.face] | (curls + tufts + 6 * (edge - 0.6) > 0)
    shade = _unit(gaussian_filter(noise[0], 1.2)) + 0.6 * curls + 0.8 * tufts
    return Strands(np.exp(0.2 * shade).astype(np.float64), np.where(opaque, 255, 0).astype(np.uint8))


def _unit(field: np.ndarray) -> np.ndarray:
    """Normalise to mean 0 and standard deviation 1."""
    return (field - field.mean()) / field.std()
