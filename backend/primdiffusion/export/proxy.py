"""A textured mesh of a human in T pose, skinned to 24 joints, for programs without volume rendering; and its files."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8
from numpy import ndarray as Array
from PIL import Image
from scipy import ndimage, sparse, spatial
from torch import Tensor

from primdiffusion.export.simplify import simplify_and_unwrap
from primdiffusion.export.surface import OuterSurface, outside_surface
from primdiffusion.files.whole_files import atomic_path
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.formats.requests import VOXEL, ProxySettings
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart, vertex_normals
from primdiffusion.human import Human, body_of, place, sole_height
from primdiffusion.people.gltf import Skeleton, glb
from primdiffusion.primitives.anchors import anchor_skin_weights
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.raster.uv_atlas import rasterise_uv
from primdiffusion.render.merge import Merged, merge
from primdiffusion.runtime.worker_process import run_in_process

OUTSIDE = 0.008
"""Start of a texel's ray: distance outside the surface, metres."""
INSIDE = 0.024
"""End of a texel's ray: depth below the surface, metres."""
STEP = 0.002
NEAREST_BOXES = 16
"""Boxes whose skin weights a vertex takes."""
FALLOFF = 0.03
"""Distance beyond the nearest box's centre at which the weight of a box is 1/e of that one's, metres."""
SMOOTHING = 6
"""Smoothing iterations of skin weights along the mesh."""
INFLUENCES = 4
"""Joints per vertex, the limit of glTF and game engines."""
RAYS_AT_ONCE = 2**16
OnStage = Callable[[str, int, int], None]
"""Progress callback: name of the current stage, stages completed, stages in total."""
FORMAT_VERSION = 1
ARRAYS, TEXTURE = "proxy.npz", "proxy.png"


DEFAULT_PROXY = ProxySettings()


@dataclasses.dataclass(frozen=True, eq=False)
class MeshProxy:
    """A mesh in the T pose of the human's betas; metres, y up, facing z; in the space of the body model."""

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
    sole_height: float
    """Height of the body's soles in the rest pose, metres (`human.sole_height`)."""

    def on_floor(self) -> MeshProxy:
        """The same with its soles at y = 0, as other programs expect it."""
        up = np.array([0.0, -self.sole_height, 0.0])
        skeleton = dataclasses.replace(self.skeleton, positions=self.skeleton.positions + up)
        return dataclasses.replace(self, vertices=self.vertices + up, skeleton=skeleton, sole_height=0.0)

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

    Exceptions raised by `on_stage` cancel. Raises ValueError. Takes about ten seconds of processor time.
    """
    body, anchors = body_of(human)
    primitives = place(human)
    on_stage("surface", 0, 3)
    grid = merge(primitives, settings.spacing, points=1)
    fine = outside_surface(grid, lambda: on_stage("surface", 0, 3))
    *coarse, corner_uv = run_in_process(
        simplify_and_unwrap,
        *fine,
        settings.triangles,
        settings.texture_px,
        on_wait=lambda: on_stage("unwrap", 1, 3),
    )
    surface = OuterSurface(*coarse)
    weights = skin_weights(primitives, surface, anchor_skin_weights(anchors, body))
    colours = grid if settings.spacing <= VOXEL else merge(primitives, points=1)
    texture = bake_texture(colours, surface, corner_uv, settings.texture_px, lambda: on_stage("texture", 2, 3))
    joints = body.shape(human.betas).joints.detach().double().numpy()
    skeleton = Skeleton(JOINT_NAMES, body.parents.tolist(), joints)
    return MeshProxy(surface.vertices, surface.faces, corner_uv, weights, texture, skeleton, sole_height(human))


def skin_weights(
    primitives: Primitives, surface: OuterSurface, box_weights: Float[Tensor, "k 24"]
) -> Float32[Array, "v 24"]:
    """Skin weights of the vertices: a mean over the nearest boxes, smoothed along the mesh, of INFLUENCES joints.

    A box may reach into the other leg and must not move it, so closeness to its centre decides.
    """
    centres = spatial.KDTree(primitives.position.detach().cpu().numpy())
    away, box = centres.query(surface.vertices, min(NEAREST_BOXES, centres.n))
    share = np.exp((away[:, :1] ** 2 - away**2) / FALLOFF**2)
    weights = np.einsum("vb,vbj->vj", share, box_weights.detach().cpu().numpy()[box]).astype(np.float32)
    count = len(surface.vertices)
    edges = np.concatenate([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]])
    links = sparse.csr_array((np.ones(len(edges), np.float32), tuple(edges.T)), shape=(count, count))
    links = ((links + links.T + sparse.eye_array(count)) > 0).astype(np.float32)
    for _ in range(SMOOTHING):
        weights = links @ weights
        weights /= weights.sum(1, keepdims=True)
    largest = np.sort(weights, 1)[:, -INFLUENCES][:, None]
    weights = np.where(weights >= largest, weights, 0)
    return (weights / weights.sum(1, keepdims=True)).astype(np.float32)


def bake_texture(
    grid: Merged,
    surface: OuterSurface,
    corner_uv: Float[Array, "f 3 2"],
    texture_px: int,
    on_wait: Callable[[], None] = lambda: None,
) -> UInt8[Array, "h w 3"]:
    """Bake a texture by marching inwards along each texel's normal; texels outside all charts copy the nearest one."""
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
        colour[some], alpha[some] = _march_inwards(grid, starts, -normals[some])
        on_wait()
    seen = alpha > 0.1
    picture = np.zeros((texture_px, texture_px, 3), np.float32)
    picture[row[seen], column[seen]] = encode_srgb(np.clip(colour[seen], 0, 1))
    known = np.zeros((texture_px, texture_px), bool)
    known[row[seen], column[seen]] = True
    nearest = np.asarray(ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True))
    picture = picture[tuple(nearest)][::-1]  # v points up, rows of a picture down
    return np.rint(picture * 255).astype(np.uint8)


def _march_inwards(grid: Merged, origins: Array, directions: Array) -> tuple[Array, Array]:
    """Straight (not premultiplied) linear colour [N, 3] and opacity [N] along rays [N, 3] of OUTSIDE + INSIDE metres.

    Composited as by the marcher: opacities add up until 1 is reached (SPEC 4). Empty rays are black.
    """
    colour, alpha = np.zeros((len(origins), 3)), np.zeros(len(origins))
    for step in range(round((OUTSIDE + INSIDE) / STEP)):
        rays = np.flatnonzero(alpha < 1)
        at = ((origins[rays] + (step + 0.5) * STEP * directions[rays] - grid.origin) / grid.voxel).T
        part = np.minimum(ndimage.map_coordinates(grid.density, at, order=1) * STEP, 1 - alpha[rays])
        met = part > 0
        rays, at, part = rays[met], at[:, met], part[met]
        alpha[rays] += part
        for channel in range(3):
            colour[rays, channel] += part * ndimage.map_coordinates(grid.colour[..., channel], at, order=1)
    return colour / np.maximum(alpha, 1e-12)[:, None], alpha


def write_proxy_glb(path: str | Path, proxy: MeshProxy, provenance: Mapping[str, Any]) -> None:
    """Write one .glb: mesh, texture, skin and skeleton; y up, facing z, as glTF requires, soles at y = 0.

    Raises OSError.
    """
    proxy = proxy.on_floor()
    with atomic_path(path) as unfinished:
        unfinished.write_bytes(glb(proxy.mesh(), proxy.skeleton, {"primdiffusion": dict(provenance)}))


def write_proxy_arrays(folder: Path, proxy: MeshProxy) -> None:
    """Write ARRAYS and TEXTURE for Blender.

    vertices [V,3], faces [F,3], uv_corner [F,3,2] (v up), skin_weights [V,24], joints [24,3], joint_names [24]; metres,
    y up, facing z. Raises OSError.
    """
    np.savez(
        folder / ARRAYS,
        format_version=np.int64(FORMAT_VERSION),
        joint_names=np.array(proxy.skeleton.names),
        joints=np.asarray(proxy.skeleton.positions, np.float64),
        vertices=proxy.vertices,
        faces=proxy.faces.astype(np.int32),
        uv_corner=proxy.corner_uv,
        skin_weights=proxy.skin_weights,
    )
    Image.fromarray(proxy.texture).save(folder / TEXTURE)
