"""Recolour clothes: replace the colours of each piece, keep the texture's shading, and draw two-colour patterns.

A pattern takes rest positions on the average body (metres, arms level) and returns the weight of the second colour,
0 to 1. Phases are fixed and features are at least a few centimetres wide: voxels of about one centimetre cannot
represent more detail, and a network could not learn random phases.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import binary_closing, binary_dilation, binary_erosion, distance_transform_edt, gaussian_filter

from primdiffusion.people import colours
from primdiffusion.people.assets import Assets
from primdiffusion.people.base_mesh import BaseMesh
from primdiffusion.people.colours import bytes_from_linear, lab_from_bytes, luminance
from primdiffusion.people.fitting import connected_faces, fit_item, uv_islands
from primdiffusion.people.wardrobe import Garment, Kind, Piece, stream
from primdiffusion.raster.uv_atlas import texel_map

SIZE = 512
"""Texture size; a texel covers about 3 mm of cloth."""
ORIGINAL_SHARE: dict[str, float] = {"denim": 0.3, "shoe": 0.5, "overall": 0.2, "sock": 1.0}
"""Probability that a piece keeps the pack's own colours."""
PLAIN_TRIM_SHARE = 0.8
"""Probability that trim takes the colour of its piece; never for the shirt and tie of a suit."""
TRIM_DISTANCE = 24.0
"""Lab distance from a piece's main colour beyond which a texel is trim."""


TIE_CHROMA = 7.0
"""Lab chroma of a suit's trim above which it is a tie; shirts are white."""
MOST_LETTERING = 0.5
"""Share of a piece that lettering and its rim cover at most."""
RIM = 2
"""Width of the border of an island that is mixed with the background, texels."""
CREASE_SPREADS, CREASE_DEPTHS = (14, 1), (0.02, 0.02)
"""Size (texels) and relative depth of creases and weave for cloth without a texture."""
SKIN_DISTANCE, TRIES = 22.0, 8
"""Smallest Lab distance between cloth and skin, and the attempts to draw such a colour."""


@dataclasses.dataclass(frozen=True, eq=False)
class Cloth:
    """The parts of a garment's texture that recolouring keeps."""

    original: UInt8[np.ndarray, "H W 4"] | None
    """The pack's texture; None if it has none."""
    piece: UInt8[np.ndarray, "H W"]
    trim: np.ndarray
    """[H, W] bool."""
    shade: Float[np.ndarray, "H W"]
    """Shading, with median 1."""
    position: Float[np.ndarray, "H W 3"]
    """Rest position on the average body, metres."""


@dataclasses.dataclass(frozen=True, eq=False)
class Paint:
    """The colours of one piece."""

    main: Float[np.ndarray, "3"]
    trim: Float[np.ndarray, "3"]
    second: Float[np.ndarray, "3"]
    pattern: str
    """A name of `PATTERNS`, "solid", or "original" for the pack's own colours."""


@functools.lru_cache(maxsize=24)
def cloth(assets: Assets, base: BaseMesh, garment: Garment) -> Cloth:
    """Decompose a garment's texture into pieces, trim, shading and position. Takes about 0.25 s, then cached."""
    _, mesh = assets.proxy(garment.path)
    texels = texel_map(mesh.corner_uv, SIZE)
    pieces = uv_islands(mesh.corner_uv) if garment.by_island else connected_faces(mesh.faces, len(mesh.vertices))
    piece = np.minimum(pieces, len(garment.pieces) - 1).astype(np.uint8)[texels.face]
    position = texels.sample(fit_item(assets, base, garment.path, base.template), mesh.faces)
    original = None
    name = f"{garment.path}_diffuse"
    if assets.has_picture(name):
        original = assets.picture(name, SIZE)
        light = luminance(original[..., :3])
    else:
        light = _creases(garment.path)
    trim = np.zeros((SIZE, SIZE), bool)
    shade = np.ones((SIZE, SIZE), np.float64)
    for number, kind in enumerate(garment.pieces):
        here = piece == number
        seen = here & texels.inside
        if not seen.any():
            continue
        other = np.zeros_like(seen)
        if original is not None and (kind.trim or kind.smooth):
            lab = lab_from_bytes(original[..., :3])
            distance = np.linalg.norm((lab - np.median(lab[seen], axis=0)) * np.array([0.8, 1, 1], np.float64), axis=-1)
            other = here & (distance > TRIM_DISTANCE)
        if original is not None and kind.trim and kind.smooth:
            tie = here & np.asarray(
                binary_closing(np.hypot(lab[..., 1], lab[..., 2]) > TIE_CHROMA, np.ones((5, 5)), 2), bool
            )
            light = np.where(tie, _blurred(light, tie), light)
            trim |= other & ~tie
        elif kind.trim:
            trim |= other
        elif kind.smooth:
            near = np.asarray(binary_dilation(other, iterations=RIM), bool)
            lettering = near[seen].mean() < MOST_LETTERING  # and not stripes, whose mean is the shading
            light = np.where(here, _blurred(light, seen & ~near if lettering else seen), light)
        for region in (here & ~trim, here & trim):
            if (region & texels.inside).any():
                middle = np.median(light[region & texels.inside])
                shade[region] = np.clip((light[region] + 0.01) / (middle + 0.01), 0.15, 2.2) ** 0.75
    nearest = _inner_texels(texels.inside)
    shade = (shade * _occlusion(assets, garment))[nearest]
    return Cloth(original, piece, trim[nearest], shade, position.astype(np.float64))


def paint_garment(
    garment: Garment, draws: np.random.Generator, skin: UInt8[np.ndarray, "3"] | None = None
) -> tuple[Paint, ...]:
    """Draw colours for every piece; those of a kind share them, none is close to `skin`, and at most one is vivid."""
    by_kind: dict[Kind, Paint] = {}
    for piece in garment.pieces:
        if piece.kind in by_kind:
            continue
        vivid = any(colours.is_vivid(paint.main) for kind, paint in by_kind.items() if kind != "denim")
        for _ in range(TRIES):
            paint = _paint(piece, draws)
            like_skin = skin is not None and _is_skin(paint.main, skin)
            if not like_skin and not (vivid and piece.kind != "denim" and colours.is_vivid(paint.main)):
                break
        by_kind[piece.kind] = paint
    return tuple(by_kind[piece.kind] for piece in garment.pieces)


def coloured(fabric: Cloth, paints: tuple[Paint, ...]) -> UInt8[np.ndarray, "H W 4"]:
    """Make the garment's texture in new colours."""
    main = np.stack([paint.main for paint in paints]).astype(np.float64)
    trim = np.stack([paint.trim for paint in paints]).astype(np.float64)
    target = np.where(fabric.trim[..., None], trim[fabric.piece], main[fabric.piece])
    for number, paint in enumerate(paints):
        if paint.pattern in PATTERNS:
            here = (fabric.piece == number) & ~fabric.trim
            share = PATTERNS[paint.pattern][1](fabric.position[here])[:, None].astype(np.float64)
            target[here] += share * (paint.second - paint.main).astype(np.float64)
    texture = np.full((*fabric.piece.shape, 4), 255, np.uint8)
    texture[..., :3] = bytes_from_linear(np.clip(target * fabric.shade[..., None], 0, 1))
    if fabric.original is not None:
        texture[..., 3] = fabric.original[..., 3]
        kept = [number for number, paint in enumerate(paints) if paint.pattern == "original"]
        here = np.isin(fabric.piece, kept)
        texture[here] = fabric.original[here]
    return texture


def _is_skin(colour: Float[np.ndarray, "3"], skin: UInt8[np.ndarray, "3"]) -> bool:
    both = lab_from_bytes(np.stack([bytes_from_linear(colour), skin]))
    return bool(np.linalg.norm(both[0] - both[1]) < SKIN_DISTANCE)


def _paint(piece: Piece, draws: np.random.Generator) -> Paint:
    """Draw the colours of a piece; tops may be printed, and denim worn."""
    kind = piece.kind
    main = colours.garment_colour(kind, draws)
    partner = "shirt" if kind in ("suit", "top") else "top"
    trim, second = (colours.contrasting(main, partner, draws) for _ in range(2))
    if kind != "suit" and draws.random() < PLAIN_TRIM_SHARE:
        trim = main
    pattern = "solid"
    if draws.random() < ORIGINAL_SHARE.get(kind, 0.0) and not piece.smooth:
        pattern = "original"
    elif draws.random() < PRINTED_SHARE.get(kind, 0.0):
        prints = [name for name, (on, _) in PATTERNS.items() if on == kind]
        pattern = prints[draws.integers(len(prints))]
    if pattern == "fades":
        second = main + FADING * (1 - main)
    return Paint(main, trim, second, pattern)


def _inner_texels(inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the texel that each texel takes its shading from: an inner one for those at an island's border.

    Borders are mixed with the background between islands and would show as dark seams.
    """
    inner = np.asarray(binary_erosion(inside, iterations=RIM), bool)
    nearest = np.asarray(distance_transform_edt(np.logical_not(inner), return_distances=False, return_indices=True))
    own = np.indices(inside.shape)
    far = inside & (np.abs(nearest - own).max(axis=0) > 3 * RIM)
    rows, columns = np.where(far, own, nearest)
    return rows, columns


def _blurred(light: Float[np.ndarray, "H W"], seen: np.ndarray) -> Float[np.ndarray, "H W"]:
    """Low-frequency shading of the `seen` texels, without fine stripes."""
    weight = gaussian_filter(seen.astype(np.float64), 8) + 1e-6
    return gaussian_filter(np.where(seen, light, 0).astype(np.float64), 8) / weight


def _creases(path: str) -> Float[np.ndarray, "H W"]:
    """Shading for cloth without a texture: shallow creases and weave, with mean 1."""
    light = np.ones((SIZE, SIZE))
    for spread, depth in zip(CREASE_SPREADS, CREASE_DEPTHS, strict=True):
        field = gaussian_filter(stream(0, f"creases of {spread} on {path}").standard_normal((SIZE, SIZE)), spread)
        light += depth * np.clip(field / field.std(), -2, 2)
    return light


def _occlusion(assets: Assets, garment: Garment) -> Float[np.ndarray, "H W"] | np.float64:
    """The pack's ambient occlusion, softened; 1 if it has none."""
    name = f"{garment.path}_ao"
    if not assets.has_picture(name):
        return np.float64(1)
    return 0.45 + 0.55 * assets.picture(name, SIZE)[..., :3].astype(np.float64).mean(-1) / 255


Pattern = Callable[[Float[np.ndarray, "*b 3"]], Float[np.ndarray, "*b"]]

SHOULDER_X, SHOULDER_Y, EDGE = 0.2, 0.254, 0.003
"""Start of the sleeves, height of the arms, and half width of soft edges, metres."""


def hanging_height(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Height with the arms hanging down, along which bands are drawn, metres."""
    along_arm = np.abs(position[..., 0]) - SHOULDER_X
    return np.where(along_arm > 0, np.minimum(position[..., 1], SHOULDER_Y) - along_arm, position[..., 1])


def stripes(position: Float[np.ndarray, "*b 3"], period: float) -> Float[np.ndarray, "*b"]:
    """Horizontal stripes around body and sleeves."""
    return _soft(_wave(hanging_height(position) / period) - 0.25, EDGE / period)


def check(position: Float[np.ndarray, "*b 3"], period: float) -> Float[np.ndarray, "*b"]:
    """Crossing bands: weight 1 at crossings, 0.5 elsewhere on a band."""
    across = np.where(np.abs(position[..., 0]) > SHOULDER_X, position[..., 2], position[..., 0])
    along = _soft(_wave(across / period) - 0.25, EDGE / period)
    return 0.5 * (stripes(position, period) + along)


def dots(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Large dots in staggered rows, projected from the front."""
    row = np.floor(position[..., 1] / 0.08)
    x = position[..., 0] / 0.1 + 0.5 * (row % 2)
    distance = np.hypot((x - np.rint(x)) * 0.1, position[..., 1] - (row + 0.5) * 0.08)
    return _soft(0.026 - distance, EDGE)


def block(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Shoulders and arms in the second colour, down to the chest."""
    return _soft(position[..., 1] - (SHOULDER_Y - 0.1), EDGE)


def chest_print(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """A ring around a disc on the chest."""
    distance = np.hypot(position[..., 0], position[..., 1] - (SHOULDER_Y - 0.15))
    drawn = np.maximum(_soft(0.03 - distance, EDGE), _soft(0.012 - np.abs(distance - 0.06), EDGE))
    return np.where(position[..., 2] > 0, drawn, 0)


def fades(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """The front of thighs and knees, as denim wears off."""
    across = (np.abs(position[..., 0]) - 0.1) / 0.05
    along = (position[..., 1] + 0.5) / 0.2
    return np.where(position[..., 2] > 0, np.exp(-(across**2) - along**4), 0)


PRINTED_SHARE: dict[str, float] = {"top": 0.22, "denim": 0.15}
"""Probability that a piece is printed: about one garment in six."""
FADING = 0.25
"""Share of white in worn denim's colour."""
PATTERNS: dict[str, tuple[Kind, Pattern]] = {
    "narrow stripes": ("top", functools.partial(stripes, period=0.08)),
    "wide stripes": ("top", functools.partial(stripes, period=0.14)),
    "check": ("top", functools.partial(check, period=0.09)),
    "large check": ("top", functools.partial(check, period=0.15)),
    "dots": ("top", dots),
    "block": ("top", block),
    "chest print": ("top", chest_print),
    "fades": ("denim", fades),
}
"""Prints by name: the kind of piece that has them, and where they are. The same print is at the same place of a garment
on every human, so that a network meets it again; only its colours differ."""


def _wave(phase: np.ndarray) -> np.ndarray:
    """A triangle wave of period 1 between 0 and 0.5."""
    return np.abs(phase - np.rint(phase))


def _soft(signed: np.ndarray, width: float) -> np.ndarray:
    """Ramp from 0 at `signed` = -width to 1 at +width."""
    return np.clip(0.5 + 0.5 * signed / width, 0, 1)
