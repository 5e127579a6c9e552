"""Convert a human to one textured mesh in T pose, skinned to 24 joints, for programs without volume rendering."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8
from numpy import ndarray as Array
from torch import Tensor

from primdiffusion.export.field import Field, march_rays, pack_field, weights_at
from primdiffusion.export.run_in_process import run_in_process
from primdiffusion.export.simplify import simplified, unwrapped
from primdiffusion.export.surface import Surface, outside_surface
from primdiffusion.formats import requests
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart, vertex_normals
from primdiffusion.geometry.uv_atlas import rasterise_uv
from primdiffusion.human import Human, body_of, place
from primdiffusion.people.gltf import Skeleton
from primdiffusion.primitives.anchors import anchor_skin_weights

OUTSIDE = 0.008
"""Start of a texel's ray: distance outside the surface, metres."""
INSIDE = 0.024
"""End of a texel's ray: depth below the surface, metres."""
STEP = 0.002
SMOOTHING = 6
"""Smoothing iterations of skin weights along the mesh."""
INFLUENCES = 4
"""Joints per vertex, the limit of glTF and game engines."""
RAYS_AT_ONCE = 2**16
OnStage = Callable[[str, int, int], None]
"""Progress callback: name of the current stage, stages completed, stages in total."""


@dataclasses.dataclass(frozen=True)
class ProxySettings:
    """Resolution of the mesh."""

    spacing: float = requests.VOXEL
    """Grid spacing of the isosurface extraction, metres."""
    triangles: int = requests.TRIANGLES
    """Maximum number of triangles."""
    texture_px: int = requests.TEXTURE_SIZE
    """Width and height of the texture, pixels."""

    def __post_init__(self) -> None:
        if not 0.003 <= self.spacing <= 0.05:
            raise ValueError(f"the grid spacing is {self.spacing} m: choose 0.003 to 0.05")
        if not 500 <= self.triangles <= 1_000_000:
            raise ValueError(f"the triangle limit is {self.triangles}: choose 500 to 1000000")
        if not 64 <= self.texture_px <= 8192:
            raise ValueError(f"the texture size is {self.texture_px} pixels: choose 64 to 8192")


DEFAULT_PROXY = ProxySettings()


@dataclasses.dataclass(frozen=True, eq=False)
class MeshProxy:
    """A mesh in the T pose of the human's betas; metres, y up, facing z."""

    vertices: Float64[Array, "v 3"]
    faces: Int64[Array, "f 3"]
    """Counter-clockwise seen from outside; closed."""
    corner_uv: Float64[Array, "f 3 2"]
    """v up."""
    skin_weights: Float32[Array, "v 24"]
    """At most INFLUENCES joints a vertex; rows sum to one."""
    texture: UInt8[Array, "h w 3"]
    """sRGB, top row first."""
    skeleton: Skeleton

    def mesh(self) -> TexturedMesh:
        """Convert to a `TexturedMesh` of one part."""
        index = np.argsort(-self.skin_weights, axis=1, kind="stable")[:, :INFLUENCES]
        weight = np.take_along_axis(self.skin_weights, index, 1).astype(np.float64)
        opaque = np.full((*self.texture.shape[:2], 1), 255, np.uint8)
        part = TexturedPart(
            "person",
            self.vertices,
            self.faces.astype(np.int32),
            self.corner_uv,
            np.concatenate([self.texture, opaque], -1),
            index,
            weight / weight.sum(1, keepdims=True),
        )
        return TexturedMesh((part,))


def mesh_proxy(human: Human, settings: ProxySettings = DEFAULT_PROXY, on_stage: OnStage = lambda *_: None) -> MeshProxy:
    """Extract the outer surface, with colours rendered by the marcher from outside.

    Exceptions raised by `on_stage` cancel. Raises NoSurface. Takes about ten seconds.
    """
    body, anchors = body_of(human)
    field = pack_field(place(human))
    on_stage("surface", 0, 3)

    def meanwhile() -> None:
        on_stage("surface", 0, 3)

    fine = outside_surface(field, settings.spacing, meanwhile)
    surface = Surface(*run_in_process(simplified, *fine, settings.triangles, meanwhile=meanwhile))
    weights = skin_weights(field, surface, anchor_skin_weights(anchors, body))
    corner_uv = run_in_process(unwrapped, *surface, settings.texture_px, meanwhile=lambda: on_stage("unwrap", 1, 3))
    texture = bake_texture(field, surface, corner_uv, settings.texture_px, lambda: on_stage("texture", 2, 3))
    joints = body.shape(human.betas).joints.detach().double().numpy()
    skeleton = Skeleton(JOINT_NAMES, body.parents.tolist(), joints)
    return MeshProxy(surface.vertices, surface.faces, corner_uv, weights, texture, skeleton)


def skin_weights(field: Field, surface: Surface, box_weights: Float[Tensor, "k 24"]) -> Float32[Array, "v 24"]:
    """Skin weights of the vertices: those of the boxes, smoothed along the mesh, limited to INFLUENCES joints."""
    from scipy import sparse

    weights = weights_at(field, surface.vertices, box_weights.detach().cpu().numpy())
    count = len(surface.vertices)
    edges = np.concatenate([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]])
    links = sparse.csr_array((np.ones(len(edges), np.float32), tuple(edges.T)), shape=(count, count))
    links = ((links + links.T + sparse.eye_array(count)) > 0).astype(np.float32)
    for _ in range(SMOOTHING):
        weights = links @ weights
        weights /= np.maximum(weights.sum(1, keepdims=True), 1e-12)  # rows of zeros take their neighbours' weights
    weights[weights.sum(1) < 0.5, 0] = 1.0
    largest = np.sort(weights, 1)[:, -INFLUENCES][:, None]
    weights = np.where(weights >= largest, weights, 0)
    return (weights / weights.sum(1, keepdims=True)).astype(np.float32)


def bake_texture(
    field: Field,
    surface: Surface,
    corner_uv: Float[Array, "f 3 2"],
    texture_px: int,
    meanwhile: Callable[[], None] = lambda: None,
) -> UInt8[Array, "h w 3"]:
    """Bake a texture by marching inwards along each texel's normal; texels outside all charts copy the nearest one."""
    from scipy import ndimage

    raster = rasterise_uv(corner_uv, texture_px, texture_px)
    row, column = np.nonzero(raster.covered)
    corners, share = surface.faces[raster.face[row, column]], raster.barycentric[row, column]
    points = np.einsum("nc,nci->ni", share, surface.vertices[corners])
    normals = np.einsum("nc,nci->ni", share, vertex_normals(*surface)[corners])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    colour, alpha = np.empty((len(points), 3), np.float32), np.empty(len(points), np.float32)
    for first in range(0, len(points), RAYS_AT_ONCE):
        some = slice(first, first + RAYS_AT_ONCE)
        starts = points[some] + OUTSIDE * normals[some]
        colour[some], alpha[some] = march_rays(field, starts, -normals[some], OUTSIDE + INSIDE, STEP)
        meanwhile()
    seen = alpha > 0.1
    picture = np.zeros((texture_px, texture_px, 3), np.float32)
    picture[row[seen], column[seen]] = encode_srgb(np.clip(colour[seen], 0, 1))
    known = np.zeros((texture_px, texture_px), bool)
    known[row[seen], column[seen]] = True
    nearest = np.asarray(ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True))
    picture = picture[tuple(nearest)][::-1]  # v points up, rows of a picture down
    return np.rint(picture * 255).astype(np.uint8)
