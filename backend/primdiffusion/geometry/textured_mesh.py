"""Textured, skinned triangle meshes in parts: a dressed human before conversion to primitives.

Conventions: metres, y up, z forward. Texture row 0 is the image's top row and the texture coordinates' v points up, so
the texel under (u, v) is column floor(u * W), row floor((1 - v) * H); coordinates outside [0, 1] wrap around.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int, UInt8

DEGENERATE_M2 = 1e-14
"""Length of a sum of faces' normals, twice their areas, below which it has no direction."""


@dataclasses.dataclass(frozen=True, eq=False)
class TexturedPart:
    """A mesh with one texture, such as a body or a garment. Arrays may be shared: never write to them."""

    name: str
    """Name such as "body", "outfit", "hair"; unique within a mesh."""
    vertices: Float[np.ndarray, "V 3"]
    """Metres, float64."""
    faces: Int[np.ndarray, "F 3"]
    """Vertex numbers, int32, counter-clockwise seen from outside."""
    corner_uv: Float[np.ndarray, "F 3 2"]
    """Texture coordinates of every corner, v up."""
    texture: UInt8[np.ndarray, "H W 4"]
    """sRGB-encoded colour and straight (not premultiplied) alpha; 1 x 1 is a plain colour."""
    skin_index: Int[np.ndarray, "V M"]
    """Joints (of 24) that influence each vertex; M is 4 for MakeHuman samples."""
    skin_weight: Float[np.ndarray, "V M"]
    """Weights of the joints; each row sums to one."""

    def __post_init__(self) -> None:
        """Check that the shapes of the arrays agree.

        Raises:
            ValueError: an array's shape does not match the others.
        """
        vertex_count, face_count = len(self.vertices), len(self.faces)
        fits = {
            "vertices": self.vertices.shape == (vertex_count, 3),
            "faces": self.faces.shape == (face_count, 3),
            "corner_uv": self.corner_uv.shape == (face_count, 3, 2),
            "texture": self.texture.ndim == 3 and self.texture.shape[2] == 4 and self.texture.dtype == np.uint8,
            "skin_index": self.skin_index.ndim == 2 and len(self.skin_index) == vertex_count,
            "skin_weight": self.skin_weight.shape == self.skin_index.shape,
        }
        for field, right in fits.items():
            if not right:
                array = getattr(self, field)
                raise ValueError(
                    f"Part {self.name!r}: {field} has shape {array.shape} ({array.dtype}), which does not match "
                    f"{vertex_count} vertices and {face_count} faces; see TexturedPart for the shapes."
                )

    def posed(self, skinning: Float[np.ndarray, "J 4 4"]) -> TexturedPart:
        """The part moved by linear blend skinning: v' = sum_m weight_m (skinning[joint_m] @ v)."""
        matrices = np.einsum("vm,vmij->vij", self.skin_weight, np.asarray(skinning, np.float64)[self.skin_index, :3])
        moved = np.einsum("vij,vj->vi", matrices[:, :, :3], self.vertices) + matrices[:, :, 3]
        return dataclasses.replace(self, vertices=moved)


def vertex_normals(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    """Area-weighted unit normals, outwards; zero where there are no faces, or only degenerate ones."""
    first, second = np.diff(vertices[faces], axis=1).swapaxes(0, 1)
    of_faces = np.cross(first, second).repeat(3, axis=0)
    sums = np.stack([np.bincount(faces.ravel(), of_face, len(vertices)) for of_face in of_faces.T], 1)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.divide(sums, length, out=np.zeros_like(sums), where=length > DEGENERATE_M2)


@dataclasses.dataclass(frozen=True, eq=False)
class TexturedMesh:
    """Textured parts that share one skeleton, such as a dressed human."""

    parts: tuple[TexturedPart, ...]

    def posed(self, skinning: Float[np.ndarray, "J 4 4"]) -> TexturedMesh:
        """Skin every part with `skinning`, the world <- rest transforms of a posed body's joints."""
        return TexturedMesh(tuple(part.posed(skinning) for part in self.parts))

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Lowest and highest coordinates over all parts, metres."""
        low = np.min([part.vertices.min(0) for part in self.parts], axis=0)
        high = np.max([part.vertices.max(0) for part in self.parts], axis=0)
        return np.stack([low, high])
