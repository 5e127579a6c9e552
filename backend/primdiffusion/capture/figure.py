"""A person ready to be drawn many times: textures and topology once, vertices and normals for each pose."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32

from primdiffusion.capture.soup import flatten
from primdiffusion.capture.texture_pyramid import TexturePyramid, texture_pyramid
from primdiffusion.geometry.textured_mesh import TexturedMesh

SAME_PLACE = 1e-6
"""Vertices of a part nearer than this (metres, in the rest pose) are one to normals: seams of textures stay smooth."""


@dataclasses.dataclass(frozen=True, eq=False)
class Figure:
    """What of a person no pose changes. All parts one after the other."""

    mesh: TexturedMesh
    """In the rest pose."""
    faces: Int32[np.ndarray, "F 3"]
    corner_uv: Float32[np.ndarray, "F 3 2"]
    part: Int32[np.ndarray, "F"]
    """Which part a face belongs to."""
    textures: TexturePyramid
    skin_index: Int32[np.ndarray, "V M"]
    skin_weight: Float32[np.ndarray, "V M"]
    corner: Int32[np.ndarray, "V"]
    """Vertices in one place of a part share a number; normals are means over these."""

    def posed(self, skinning: Float[np.ndarray, "J 4 4"]) -> PosedFigure:
        """The figure moved by linear blend skinning, world <- rest."""
        vertices = np.concatenate([part.posed(skinning).vertices for part in self.mesh.parts])
        return PosedFigure(self, vertices, self._normals(vertices))

    def _normals(self, vertices: np.ndarray) -> np.ndarray:
        """Means of the normals of the faces about each place, weighted with their areas; unit length."""
        corners = vertices[self.faces]
        doubled_area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        places = self.corner[self.faces]
        total = np.stack(
            [
                np.bincount(places.ravel(), np.repeat(doubled_area[:, axis], 3), minlength=self.corner.max() + 1)
                for axis in range(3)
            ],
            -1,
        )
        total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
        return total[self.corner].astype(np.float32)


@dataclasses.dataclass(frozen=True, eq=False)
class PosedFigure:
    """A person in a pose."""

    figure: Figure
    vertices: Float64[np.ndarray, "V 3"]
    """Metres."""
    normals: Float32[np.ndarray, "V 3"]
    """Unit, out of the front of the faces."""


def figure_of(mesh: TexturedMesh) -> Figure:
    """The mesh ready to be drawn.

    Raises:
        UnusableMesh: no part has a face, a coordinate is not finite, a face names a vertex that is not there, or a
            texture has no texel.
    """
    soup = flatten(mesh)
    most = max(part.skin_index.shape[1] for part in mesh.parts)
    first = 0
    corners = []
    for part in mesh.parts:
        places = np.round(part.vertices / SAME_PLACE).astype(np.int64)
        _, corner = np.unique(places, axis=0, return_inverse=True)
        corners.append(corner.reshape(-1) + first)
        first += len(part.vertices)
    return Figure(
        mesh=mesh,
        faces=soup.faces,
        corner_uv=soup.corner_uv,
        part=soup.part,
        textures=texture_pyramid(mesh),
        skin_index=np.concatenate([_wide(part.skin_index, most) for part in mesh.parts]).astype(np.int32),
        skin_weight=np.concatenate([_wide(part.skin_weight, most) for part in mesh.parts]).astype(np.float32),
        corner=np.concatenate(corners).astype(np.int32),
    )


def _wide(rows: np.ndarray, columns: int) -> np.ndarray:
    return np.pad(rows, ((0, 0), (0, columns - rows.shape[1])))
