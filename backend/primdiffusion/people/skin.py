"""Skin textures of any tone for both sexes, interpolated between the few textures of the pack.

Tone 0 is a light texture, tone 1 has the local mean colour (Lab) of a dark one, with linear interpolation in between.
Local means are used because palms, soles and scalp differ less between light and dark skin than the rest. Detail finer
than the local mean is the base texture's, so that female skins can be dark although the pack's dark textures are male.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from scipy.ndimage import gaussian_filter

from primdiffusion.people.assets import Assets, AssetsMissingError
from primdiffusion.people.colour import bytes_from_lab, lab_from_bytes
from primdiffusion.people.wardrobe import Sex

SIZE = 1024
COARSE = 256
"""Resolution of the local mean, texels."""
SPREAD = 6.0
"""Standard deviation of the local mean's window, texels of COARSE."""
BROAD_SPREAD, EVENED = 16.0, (0.3, 0.6, 0.6)
"""Window (texels of COARSE) and strength (L, a, b) with which limbs are shifted towards the skin's median colour."""
FOLDER = "skins/textures"
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
        AssetsMissingError: there are no light skins of this sex or no dark skins.
    """
    light = _textures(assets, f"lightskinned_{sex}")
    dark = _textures(assets, f"darkskinned_{sex}")
    any_dark = dark or _textures(assets, "darkskinned")
    if not light or not any_dark:
        raise AssetsMissingError(
            f"no light {sex} skins or no dark skins in {assets.root / FOLDER}: fetch the whole asset pack"
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
        name for name in assets.pictures(FOLDER, f"_{word}") if not any(left_out in name for left_out in LEFT_OUT)
    )


@functools.lru_cache(maxsize=32)
def _lab(assets: Assets, name: str) -> np.ndarray:
    """A skin texture in Lab, half precision."""
    return lab_from_bytes(assets.picture(name, SIZE)[..., :3]).astype(np.float16)


@functools.lru_cache(maxsize=32)
def _local_mean(assets: Assets, name: str) -> Float[np.ndarray, "COARSE COARSE 3"]:
    """Local mean colour of a skin texture, Lab."""
    lab = lab_from_bytes(assets.picture(name, COARSE)[..., :3])
    return gaussian_filter(lab, (SPREAD, SPREAD, 0))
