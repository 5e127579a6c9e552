"""All triangles and textures of a mesh in a few flat arrays, the form that compiled loops read."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt8

from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart


class UnusableMesh(ValueError):
    """A textured mesh that cannot be drawn: empty, not finite, or with faces that name no vertex."""


@dataclasses.dataclass(frozen=True, eq=False)
class TriangleSoup:
    """Triangles of all parts, parts one after the other."""

    vertices: Float64[np.ndarray, "V 3"]
    """Metres."""
    faces: Int32[np.ndarray, "F 3"]
    """Numbers into `vertices`."""
    corner_uv: Float32[np.ndarray, "F 3 2"]
    """v up, as in TexturedPart."""
    part: Int32[np.ndarray, "F"]
    """Which part a face belongs to."""
    texels: Textures


@dataclasses.dataclass(frozen=True, eq=False)
class Textures:
    """The textures of all parts, row after row, in one array."""

    rgba: UInt8[np.ndarray, "texels 4"]
    """sRGB-encoded colour and straight alpha."""
    start: Int64[np.ndarray, "P"]
    """Where a part's first texel is."""
    size: Int32[np.ndarray, "P 2"]
    """Rows and columns."""
    cut_out: Bool[np.ndarray, "P"]
    """Whether any texel fails the alpha test, so that drawing has to look."""


ALPHA_TEST = 128
"""Texels with a smaller alpha (of 255) are holes."""


def flatten(mesh: TexturedMesh) -> TriangleSoup:
    """The mesh as a soup.

    Raises:
        UnusableMesh: no part has a face, a coordinate is NaN or infinite, a face names a vertex that is not there, or a
            texture has no texel.
    """
    parts = [part for part in mesh.parts if len(part.faces)]
    if not parts:
        raise UnusableMesh(f"The mesh has no triangles in its {len(mesh.parts)} parts; give it at least one.")
    for part in parts:
        _check(part)
    first = np.cumsum([0] + [len(part.vertices) for part in mesh.parts])
    return TriangleSoup(
        vertices=np.concatenate([np.asarray(part.vertices, np.float64) for part in mesh.parts]),
        faces=np.concatenate([part.faces.astype(np.int32) + np.int32(first[i]) for i, part in enumerate(mesh.parts)]),
        corner_uv=np.concatenate([part.corner_uv.astype(np.float32) for part in mesh.parts]),
        part=np.repeat(np.arange(len(mesh.parts), dtype=np.int32), [len(part.faces) for part in mesh.parts]),
        texels=gather_textures(mesh),
    )


def gather_textures(mesh: TexturedMesh) -> Textures:
    """The textures of a mesh, one after the other.

    Raises:
        UnusableMesh: a part's texture has no texel.
    """
    for part in mesh.parts:
        if part.texture.size == 0:
            raise UnusableMesh(
                f"Part {part.name!r} has an empty texture of shape {part.texture.shape}; "
                "a plain colour is a 1 x 1 texture."
            )
    flat = [np.ascontiguousarray(part.texture).reshape(-1, 4) for part in mesh.parts]
    return Textures(
        rgba=np.concatenate(flat),
        start=np.cumsum([0] + [len(texels) for texels in flat])[:-1].astype(np.int64),
        size=np.array([part.texture.shape[:2] for part in mesh.parts], np.int32),
        cut_out=np.array([bool((texels[:, 3] < ALPHA_TEST).any()) for texels in flat]),
    )


def _check(part: TexturedPart) -> None:
    """Refuse what a compiled loop would read out of bounds or lose silently."""
    for name, values in (("vertices", part.vertices), ("corner_uv", part.corner_uv)):
        if not np.isfinite(values).all():
            raise UnusableMesh(
                f"Part {part.name!r} has {int((~np.isfinite(values)).sum())} NaN or infinite values in {name}; "
                "repair or drop the part."
            )
    low, high = int(part.faces.min()), int(part.faces.max())
    if low < 0 or high >= len(part.vertices):
        raise UnusableMesh(
            f"Part {part.name!r} has faces that name vertices {low} to {high}, but only {len(part.vertices)} vertices; "
            "repair the faces."
        )
