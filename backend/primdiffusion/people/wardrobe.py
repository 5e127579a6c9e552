"""Catalogue of garments and hair, and the random choice of an outfit; names only, no files.

The tables list the meshes of the asset pack and the kind of each connected piece of a garment (largest first), which
determines its colours and patterns.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Float

Sex = Literal["female", "male"]
Kind = Literal[
    "top", "denim", "trousers", "tights", "skirt", "jacket", "suit", "overall", "shirt", "shoe", "sock", "hat", "detail"
]


@dataclasses.dataclass(frozen=True)
class Piece:
    """A connected piece of a garment."""

    kind: Kind
    trim: bool = False
    """The texture has parts of a clearly different colour (a shirt under a jacket), coloured separately."""
    smooth: bool = False
    """The texture has fine stripes or lettering, which primitives cannot represent: only its smooth shading is used."""


@dataclasses.dataclass(frozen=True)
class Garment:
    """A mesh of the pack and the kinds of its pieces."""

    name: str
    pieces: tuple[Piece, ...]
    by_island: bool = False
    """Pieces are UV islands instead of connected components of the mesh."""
    mesh: str = ""
    """Name of the mesh, if it is another garment's."""
    lengthened: float = 1.0
    """Factor on the length of its skirt."""

    @property
    def path(self) -> str:
        """Path of its files in the asset folder, without extension."""
        return f"clothes/{self.mesh or self.name}/{self.mesh or self.name}"


SMOOTHED_TOP, PLAIN_TOP = Piece("top", smooth=True), Piece("top")
DENIM, DETAIL = Piece("denim"), Piece("detail")
INNER_SHIRT = Piece("shirt", smooth=True)

_SKIRT = (SMOOTHED_TOP, Piece("skirt"))
UNISEX = (
    Garment("female_casualsuit01", (SMOOTHED_TOP, DENIM)),
    Garment("female_casualsuit02", (DENIM, PLAIN_TOP, DETAIL)),
    Garment("male_casualsuit01", (DENIM, PLAIN_TOP, DENIM, PLAIN_TOP, PLAIN_TOP, PLAIN_TOP), by_island=True),
    Garment("male_casualsuit02", (SMOOTHED_TOP, DENIM)),
    Garment("male_casualsuit03", (SMOOTHED_TOP, DENIM)),
    Garment("male_casualsuit04", (DENIM, SMOOTHED_TOP)),
    Garment("male_casualsuit05", (Piece("jacket"), DENIM, INNER_SHIRT, INNER_SHIRT)),
    Garment("male_casualsuit06", (SMOOTHED_TOP, DENIM)),
    Garment("male_elegantsuit01", (Piece("suit", trim=True, smooth=True), Piece("suit"))),
    Garment("male_worksuit01", (Piece("overall"), PLAIN_TOP, DETAIL, DETAIL, DETAIL, DETAIL)),
)
"""Garments for both sexes, whichever the pack made them for."""
OUTFITS: dict[Sex, tuple[Garment, ...]] = {
    "female": (
        *UNISEX,
        Garment("female_elegantsuit01", _SKIRT),
        Garment("female_elegantsuit01_long", _SKIRT, mesh="female_elegantsuit01", lengthened=1.45),
        Garment("female_sportsuit01", (SMOOTHED_TOP, Piece("tights", trim=True))),
    ),
    "male": UNISEX,
}
SKIRTS = {
    garment.path: tuple(number for number, piece in enumerate(garment.pieces) if piece.kind == "skirt")
    for garments in OUTFITS.values()
    for garment in garments
    if any(piece.kind == "skirt" for piece in garment.pieces)
}
"""Outfits with a skirt, and the indices of its pieces."""

_SHOE = (Piece("shoe"), Piece("shoe"), Piece("sock"), Piece("sock"))
SHOES: tuple[Garment, ...] = (
    Garment("shoes01", _SHOE),
    Garment("shoes02", _SHOE),
    Garment("shoes03", (*_SHOE, *(Piece("shoe"),) * 8)),
    Garment("shoes04", _SHOE),
    Garment("shoes05", _SHOE),
    Garment("shoes06", _SHOE),
)

HATS = ("clothes/fedora01/fedora", "clothes/fedora01/fedora_cocked")
HAIR: dict[Sex, dict[str, float]] = {
    "female": {
        "bob01": 0.05,
        "bob02": 0.1,
        "long01": 0.18,
        "ponytail01": 0.18,
        "braid01": 0.13,
        "short01": 0.05,
        "short02": 0.07,
        "short03": 0.09,
        "short04": 0.05,
        "afro01": 0.1,
    },
    "male": {
        "short01": 0.19,
        "short02": 0.2,
        "short04": 0.2,
        "short03": 0.14,
        "afro01": 0.13,
        "long01": 0.05,
        "ponytail01": 0.06,
        "bob02": 0.03,
    },
}
"""Probabilities; low for the bob that hides an eye."""
HAT_HAIR: dict[Sex, dict[str, float]] = {
    "female": {"bob02": 0.2, "long01": 0.4, "ponytail01": 0.25, "short02": 0.15},
    "male": {"short01": 0.3, "short02": 0.3, "short04": 0.3, "ponytail01": 0.1},
}
EYEBROWS = tuple(f"eyebrows/eyebrow{number:03d}/eyebrow{number:03d}" for number in range(1, 13))
EYELASHES = tuple(f"eyelashes/eyelashes{number:02d}/eyelashes{number:02d}" for number in range(1, 5))
FEMALE_EYELASHES = 3
"""Number of natural-looking ones; the last is stage make-up."""
FEMALE_EYEBROWS, MALE_EYEBROWS = (0, 1, 3, 5, 6, 9, 10), (0, 1, 2, 3, 4, 7, 9, 11)
EYES = "eyes/low-poly/low-poly"

HAT_SHARE, BALD_SHARE = 0.08, 0.08
LARGEST_DRAWN_BETA, BETA_DIGITS = 2.0, 6
STATURE: dict[Sex, float] = {"female": -0.6, "male": 0.05}
STATURE_SPREAD = 0.55
"""The first beta is height, 14 cm per unit around 1.76 m: men are 1.77 +- 0.08 m tall, women 1.68 +- 0.08 m."""


@dataclasses.dataclass(frozen=True, eq=False)
class Choice:
    """Body and meshes of a human, without colours."""

    sex: Sex
    betas: Float[np.ndarray, "10"]
    outfit: Garment
    shoes: Garment
    hat: str | None
    hair: str | None
    eyebrows: str
    eyelashes: str


def stream(seed: int, purpose: str) -> np.random.Generator:
    """Random generator for one purpose, independent of the numbers drawn for others."""
    return np.random.default_rng([seed, zlib.crc32(purpose.encode())])


def required_meshes() -> tuple[str, ...]:
    """All meshes that may be used, as relative paths without extension."""
    clothes = [garment.path for outfits in OUTFITS.values() for garment in outfits] + [shoe.path for shoe in SHOES]
    hair = [hair_path(name) for names in HAIR.values() for name in names]
    return tuple(dict.fromkeys((*clothes, *HATS, *hair, *EYEBROWS, *EYELASHES, EYES)))


def hair_path(name: str) -> str:
    """Path of a hair mesh's files, without extension."""
    return f"hair/{name}/{name}"


def choose(seed: int, femininity: Float[np.ndarray, "10"]) -> Choice:
    """Draw body and clothes; outfits are uniform within a sex.

    Args:
        seed: determines the choice, independent of the machine.
        femininity: direction in betas from male to female.
    """
    betas, sex = draw_body(seed, femininity)
    wear = stream(seed, "wear")
    outfit = OUTFITS[sex][wear.integers(len(OUTFITS[sex]))]
    shoes = SHOES[wear.integers(len(SHOES))]
    head = stream(seed, "head")
    hat = HATS[head.integers(len(HATS))] if head.random() < HAT_SHARE else None
    bald = sex == "male" and head.random() < BALD_SHARE
    styles = HAT_HAIR[sex] if hat else HAIR[sex]
    hair = None if bald else list(styles)[head.choice(len(styles), p=list(styles.values()))]
    brows = FEMALE_EYEBROWS if sex == "female" else MALE_EYEBROWS
    return Choice(
        sex=sex,
        betas=betas,
        outfit=outfit,
        shoes=shoes,
        hat=hat,
        hair=hair,
        eyebrows=EYEBROWS[brows[head.integers(len(brows))]],
        eyelashes=EYELASHES[head.integers(FEMALE_EYELASHES) if sex == "female" else 0],
    )


def draw_body(seed: int, femininity: Float[np.ndarray, "10"]) -> tuple[Float[np.ndarray, "10"], Sex]:
    """Draw betas of N(0, 1) within LARGEST_DRAWN_BETA, and the sex that they correspond to.

    Bodies are at least half a standard deviation along `femininity` from the midpoint of the sexes, where the clothes
    of neither fit well.
    """
    draws = stream(seed, "body")
    betas = draws.standard_normal(10)
    axis = femininity / np.linalg.norm(femininity)
    side = float(betas @ axis)
    sign = 1.0 if side >= 0 else -1.0
    betas += axis * sign * max(0.0, 0.5 - abs(side))
    sex: Sex = "female" if sign > 0 else "male"
    betas = np.clip(betas, -LARGEST_DRAWN_BETA, LARGEST_DRAWN_BETA)
    betas[0] = STATURE[sex] + STATURE_SPREAD * betas[0]
    return betas.round(BETA_DIGITS), sex


WORDS = {
    "outfit": {
        "female_casualsuit01": "fitted tee and jeans",
        "female_casualsuit02": "tee and shorts",
        "female_elegantsuit01": "blouse and skirt",
        "female_elegantsuit01_long": "blouse and long skirt",
        "female_sportsuit01": "crop top and leggings",
        "male_casualsuit01": "shirt and trousers",
        "male_casualsuit02": "sweater and jeans",
        "male_casualsuit03": "long sleeves and jeans",
        "male_casualsuit04": "tee and jeans",
        "male_casualsuit05": "jacket and trousers",
        "male_casualsuit06": "loose tee and jeans",
        "male_elegantsuit01": "suit",
        "male_worksuit01": "dungarees",
    },
    "hair": {
        "none": "bald",
        "afro01": "afro",
        "bob01": "bob",
        "bob02": "long bob",
        "braid01": "braid",
        "long01": "long",
        "ponytail01": "ponytail",
        "short01": "crew cut",
        "short02": "short",
        "short03": "fringe",
        "short04": "side parting",
    },
    "hat": {"fedora": "fedora", "fedora_cocked": "cocked fedora"},
}
"""Display names of the pack's meshes; other names are used as they are."""
PLAIN = {"solid", "original", "fades"}
"""Values of `pattern` without a print on the top."""


def attribute_labels(attributes: Mapping[str, object]) -> dict[str, str]:
    """Convert attributes of `person.Person` to those that models are conditioned on; missing ones are left out.

    The result has sex, outfit, pattern, shoes, hair and hat.
    """
    words = {
        name: WORDS.get(name, {}).get(str(attributes[name]), str(attributes[name]))
        for name in ("sex", "outfit", "shoes", "hair", "hat")
        if name in attributes
    }
    if "pattern" in attributes:
        patterns = set(str(attributes["pattern"]).split(", "))
        words["pattern"] = "plain" if patterns <= PLAIN else "patterned"
    return words
