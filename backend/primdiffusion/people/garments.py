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
from scipy.ndimage import binary_erosion, distance_transform_edt, gaussian_filter

from primdiffusion.people import colours
from primdiffusion.people.assets import Assets
from primdiffusion.people.base_mesh import BaseMesh
from primdiffusion.people.colours import bytes_from_linear, lab_from_bytes, luminance
from primdiffusion.people.fitting import connected_faces, fit_item, uv_islands
from primdiffusion.people.wardrobe import Garment, Kind, Piece, stream
from primdiffusion.raster.uv_atlas import texel_map

SIZE = 512
"""Texture size; a texel covers about 3 mm of cloth."""
ORIGINAL_SHARE: dict[str, float] = {"denim": 0.3, "shoe": 0.5, "overall": 0.2, "top": 0.06, "sock": 1.0}
"""Probability that a piece keeps the pack's own colours."""
PLAIN_TRIM_SHARE = 0.5
"""Probability that trim takes the colour of its piece; never for the shirt and tie of a suit."""
TRIM_DISTANCE = 24.0
"""Lab distance from a piece's main colour beyond which a texel is trim."""


RIM = 2
"""Width of the border of an island that is mixed with the background, texels."""
CREASE_SPREADS, CREASE_DEPTHS = (14, 1), (0.06, 0.03)
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
        if kind.smooth:
            light = np.where(here, _blurred(light, seen), light)
        if kind.trim and original is not None:
            lab = lab_from_bytes(original[..., :3])
            distance = np.linalg.norm((lab - np.median(lab[seen], axis=0)) * np.array([0.8, 1, 1], np.float64), axis=-1)
            trim |= here & (distance > TRIM_DISTANCE)
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
    """Draw colours for every piece; pieces of one kind share them, and none is close to `skin`."""
    by_kind: dict[Kind, Paint] = {}
    for piece in garment.pieces:
        for _ in range(TRIES):
            if piece.kind not in by_kind or (skin is not None and _is_skin(by_kind[piece.kind].main, skin)):
                by_kind[piece.kind] = _paint(piece, draws)
    return tuple(by_kind[piece.kind] for piece in garment.pieces)


def coloured(fabric: Cloth, paints: tuple[Paint, ...]) -> UInt8[np.ndarray, "H W 4"]:
    """Make the garment's texture in new colours."""
    main = np.stack([paint.main for paint in paints]).astype(np.float64)
    trim = np.stack([paint.trim for paint in paints]).astype(np.float64)
    target = np.where(fabric.trim[..., None], trim[fabric.piece], main[fabric.piece])
    for number, paint in enumerate(paints):
        pattern = dict(PATTERNS).get(paint.pattern)
        if pattern is not None:
            here = (fabric.piece == number) & ~fabric.trim
            share = pattern(fabric.position[here])[:, None].astype(np.float64)
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
    """Draw the colours of a piece; only tops may be patterned."""
    kind = piece.kind
    main = colours.garment_colour(kind, draws)
    partner = "shirt" if kind == "suit" else "top"
    trim = colours.contrasting(main, partner, draws)
    if kind != "suit" and draws.random() < PLAIN_TRIM_SHARE:
        trim = main
    second = colours.contrasting(main, "top", draws)
    pattern = "solid"
    if kind == "top" and draws.random() > SOLID_SHARE:
        pattern = PATTERNS[draws.integers(len(PATTERNS))][0]
    if draws.random() < ORIGINAL_SHARE.get(kind, 0.0) and not piece.smooth:
        pattern = "original"
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


def bands(position: Float[np.ndarray, "*b 3"], period: float = 0.14) -> Float[np.ndarray, "*b"]:
    """Horizontal stripes around body and sleeves."""
    return _soft(_wave(hanging_height(position) / period) - 0.25, EDGE / period)


def plaid(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Crossing bands: weight 1 at crossings, 0.5 elsewhere on a band."""
    across = np.where(np.abs(position[..., 0]) > SHOULDER_X, position[..., 2], position[..., 0])
    along = _soft(_wave(across / 0.12) - 0.25, EDGE / 0.12)
    return 0.5 * (bands(position, 0.12) + along)


def dots(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Large dots in staggered rows, projected from the front."""
    row = np.floor(position[..., 1] / 0.08)
    x = position[..., 0] / 0.1 + 0.5 * (row % 2)
    distance = np.hypot((x - np.rint(x)) * 0.1, position[..., 1] - (row + 0.5) * 0.08)
    return _soft(0.026 - distance, EDGE)


def sleeves(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Sleeves in the second colour."""
    # Excludes the hips, which can be as wide.
    raised = position[..., 1] > SHOULDER_Y - 0.25
    return np.where(raised, _soft(np.abs(position[..., 0]) - SHOULDER_X + 0.02, EDGE), 0)


def yoke(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """Shoulders and arms in the second colour, down to the chest."""
    return _soft(position[..., 1] - (SHOULDER_Y - 0.1), EDGE)


def chest_band(position: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b"]:
    """One wide band around the chest and both upper arms."""
    return _soft(0.06 - np.abs(hanging_height(position) - (SHOULDER_Y - 0.14)), EDGE)


SOLID_SHARE = 0.7
PATTERNS: tuple[tuple[str, Pattern], ...] = (
    ("sleeves", sleeves),
    ("yoke", yoke),
    ("chest band", chest_band),
    ("bands", bands),
    ("plaid", plaid),
    ("dots", dots),
)


def _wave(phase: np.ndarray) -> np.ndarray:
    """A triangle wave of period 1 between 0 and 0.5."""
    return np.abs(phase - np.rint(phase))


def _soft(signed: np.ndarray, width: float) -> np.ndarray:
    """Ramp from 0 at `signed` = -width to 1 at +width."""
    return np.clip(0.5 + 0.5 * signed / width, 0, 1)
