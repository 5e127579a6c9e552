"""Generate a dressed human from a seed."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Float, UInt8

from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.people import appearance, colours, garments
from primdiffusion.people.assets import Assets
from primdiffusion.people.base_mesh import BaseMesh, draw_face, with_face
from primdiffusion.people.colours import bytes_from_linear
from primdiffusion.people.fitting import (
    connected_faces,
    cover,
    fit_item,
    item_skinning,
    lengthen,
    shown_faces,
    sink_below_cloth,
    skin_under_hem,
    skirt_faces,
    under_hat,
    with_closed_hem,
)
from primdiffusion.people.wardrobe import EYES, Choice, choose, hair_path, stream

BROW_SIZE = 512
GRID = 2.0**17
"""Vertices are rounded to 1 / GRID m, 8 micrometres."""
CLOTHES = ("outfit", "shoes")
"""Parts that hide vertices of the body. Outfits also list the base's eyes and hair, which stay visible."""


@dataclasses.dataclass(frozen=True, eq=False)
class Person:
    """A dressed, rigged human in the rest pose of the default body."""

    mesh: TexturedMesh
    """Parts "body", "eyes", "eyebrows", "eyelashes", "outfit", "shoes" and, if worn, "hair" and "hat"."""
    betas: Float[np.ndarray, "10"]
    attributes: dict[str, str | float]
    """Labels such as sex, skin tone, garments and colours."""
    choice: Choice
    assets: Assets
    base: BaseMesh


def make_person(assets: Assets, base: BaseMesh, seed: int) -> Person:
    """Generate body, clothes, hair and colours from a seed; independent of the machine.

    Takes about half a second once asset files are cached.

    Raises:
        FileNotFoundError, FileError: asset files are missing or damaged.
    """
    choice = choose(seed, femininity(base))
    return _coloured(assets, base, choice, _geometry(assets, base, choice, draw_face(stream(seed, "face"))), seed)


def recolour(person: Person, seed: int) -> Person:
    """Return the human with other colours of skin, hair, eyes and clothes; geometry arrays are shared."""
    return _coloured(person.assets, person.base, person.choice, person.mesh, seed)


@functools.lru_cache(maxsize=4)
def femininity(base: BaseMesh) -> Float[np.ndarray, "10"]:
    """Direction in betas from male to female: linear regression of gender on the shape space's samples."""
    gender = base.sample_phenotypes[:, base.phenotype_names.index("gender")]
    design = np.column_stack([base.sample_betas, np.ones(len(gender))])
    return np.linalg.lstsq(design, gender, rcond=None)[0][:-1]


def _geometry(assets: Assets, base: BaseMesh, choice: Choice, face: Float[np.ndarray, " M"]) -> TexturedMesh:
    """Fit all parts, with plain textures; coordinates are rounded so that they do not depend on the machine."""
    vertices = with_face(base.vertices(choice.betas), base, face)
    paths = {
        "outfit": choice.outfit.path,
        "shoes": choice.shoes.path,
        "eyes": EYES,
        "eyebrows": choice.eyebrows,
        "eyelashes": choice.eyelashes,
        "hair": hair_path(choice.hair) if choice.hair else None,
        "hat": choice.hat,
    }
    worn = {name: path for name, path in paths.items() if path}
    pairs = {name: assets.proxy(path) for name, path in worn.items()}
    covers = tuple(cover(assets, base, worn[name]) for name in CLOTHES)
    covered = np.any([garment.hidden for garment in covers], axis=0)
    shown = shown_faces(base, {name: (pairs[name][0], pairs[name][1].faces) for name in CLOTHES}, covered)
    plain = np.full((1, 1, 4), 255, np.uint8)
    body = TexturedPart(
        "body",
        sink_below_cloth(vertices, base, covers),
        base.faces[shown["body"]].astype(np.int32),
        base.corner_uv[shown["body"]],
        plain,
        base.joint_index,
        base.joint_weight,
    )
    parts = [_compact(body)]
    fitted = {name: fit_item(assets, base, path, vertices) for name, path in worn.items()}
    skirt = skirt_faces(choice.outfit, pairs["outfit"][1])
    if choice.outfit.lengthened != 1:
        fitted["outfit"] = lengthen(fitted["outfit"], pairs["outfit"][1].faces[skirt], choice.outfit.lengthened)
    shoes = pairs["shoes"][1].faces
    sock_pieces = [number for number, piece in enumerate(choice.shoes.pieces) if piece.kind == "sock"]
    sock = np.isin(connected_faces(shoes, len(pairs["shoes"][1].vertices)), sock_pieces)
    shown["shoes"] &= ~(sock & skin_under_hem(fitted["outfit"], fitted["shoes"], shoes))
    if choice.hair and choice.hat:
        shown["hair"] = ~under_hat(fitted["hat"], fitted["hair"], pairs["hair"][1].faces)
    for name, path in worn.items():
        _, mesh = pairs[name]
        index, weight, _ = item_skinning(assets, base, path)
        seen = shown.get(name, np.ones(len(mesh.faces), bool))
        part = TexturedPart(name, fitted[name], mesh.faces[seen], mesh.corner_uv[seen], plain, index, weight)
        if name == "outfit" and skirt.any():
            part = with_closed_hem(part, skirt[seen])
        parts.append(_compact(part))
    return TexturedMesh(tuple(parts))


def _compact(part: TexturedPart) -> TexturedPart:
    """Remove unused vertices and round the others to GRID."""
    used, faces = np.unique(part.faces, return_inverse=True)
    return dataclasses.replace(
        part,
        vertices=np.rint(part.vertices[used] * GRID) / GRID + 0.0,  # no negative zeros
        faces=faces.reshape(-1, 3).astype(np.int32),
        skin_index=part.skin_index[used],
        skin_weight=part.skin_weight[used],
    )


def _coloured(assets: Assets, base: BaseMesh, choice: Choice, mesh: TexturedMesh, seed: int) -> Person:
    """Draw all colours from a seed and texture the geometry."""
    complexion = appearance.draw_skin(assets, choice.sex, stream(seed, "skin"))
    hair_name, hair_linear = colours.hair_colour(complexion.tone, complexion.age, stream(seed, "hair colour"))
    iris = appearance.draw_eyes(assets, complexion.tone, stream(seed, "eye colour"))
    skin_picture = appearance.skin_texture(assets, complexion)
    bare = np.median(skin_picture[::16, ::16, :3].reshape(-1, 3), axis=0).astype(np.uint8)
    outfit = garments.paint_garment(choice.outfit, stream(seed, "outfit colour"), bare)
    shoes = garments.paint_garment(choice.shoes, stream(seed, "shoe colour"))
    textures: dict[str, UInt8[np.ndarray, "H W 4"]] = {
        "body": skin_picture,
        "eyes": appearance.eye_texture(assets, iris),
        "eyebrows": appearance.tint_cutout(assets.picture(choice.eyebrows, BROW_SIZE), 0.35 * hair_linear),
        "eyelashes": appearance.tint_cutout(assets.picture(choice.eyelashes, BROW_SIZE), np.full(3, 0.006)),
        "outfit": garments.coloured(garments.cloth(assets, base, choice.outfit), outfit),
        "shoes": garments.coloured(garments.cloth(assets, base, choice.shoes), shoes),
    }
    if choice.hair:
        textures["hair"] = appearance.coloured_strands(appearance.strands(assets, choice.hair), hair_linear)
    if choice.hat:
        colour = colours.garment_colour("hat", stream(seed, "hat colour"))
        textures["hat"] = np.append(bytes_from_linear(colour), np.uint8(255)).reshape(1, 1, 4)
    parts = tuple(dataclasses.replace(part, texture=textures[part.name]) for part in mesh.parts)
    attributes: dict[str, str | float] = {
        "sex": choice.sex,
        "age": complexion.age,
        "skin_tone": round(complexion.tone, 4),
        "outfit": choice.outfit.name,
        "pattern": ", ".join(dict.fromkeys(paint.pattern for paint in outfit)),
        "shoes": choice.shoes.name,
        "hair": choice.hair or "none",
        "hair_colour": hair_name,
        "hat": choice.hat.rsplit("/", 1)[-1] if choice.hat else "none",
        "eyes": iris,
        "height": round(float(mesh.parts[0].vertices[:, 1].max() - mesh.bounds[0, 1]), 4),
    }
    return Person(TexturedMesh(parts), choice.betas, attributes, choice, assets, base)
