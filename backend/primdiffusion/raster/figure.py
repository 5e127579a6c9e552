"""A person ready to be drawn many times: textures and topology once, vertices and normals for each pose."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, UInt8

from primdiffusion.body.model import J
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.raster.texture_pyramid import TexturePyramid, texture_pyramid
from primdiffusion.raster.triangle_soup import flatten

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
    joint: UInt8[np.ndarray, "F"]
    """The joint with the most weight on a face's corners."""
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
        joint=np.concatenate([_joints_of_faces(part) for part in mesh.parts]),
        corner=np.concatenate(corners).astype(np.int32),
    )


def _joints_of_faces(part: TexturedPart) -> UInt8[np.ndarray, "F"]:
    sums = np.zeros((len(part.faces), J))
    rows = np.arange(len(part.faces))[:, None]
    for corner in part.faces.T:
        np.add.at(sums, (rows, part.skin_index[corner]), part.skin_weight[corner])
    return sums.argmax(1).astype(np.uint8)
