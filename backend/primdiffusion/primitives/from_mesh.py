"""Convert a textured mesh to the payload of primitives without a network; produces the training samples."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from jaxtyping import Float32, Int32

from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.primitives.primitives import Frames, Payload, S
from primdiffusion.primitives.surface_points import carve, look_around, nearest, visible_points
from primdiffusion.raster.rasterise import TriangleSoup, flatten
from primdiffusion.raster.textures import mip_levels

FULL_DENSITY = 200.0
"""Density of solid matter, 1/m; its inverse is the attenuation length."""
RAMP = 0.020
"""Depth below the surface at which density is full, metres. A ramp centred on the surface would enlarge silhouettes."""
INSET = 0.2
"""Depth at which the ramp starts, in voxel spacings across the surface: without it, interpolation between outer and
inner voxels would enlarge the figure by about 3 mm."""
REACH = 0.030
"""Voxels farther than this from the surface (metres) take the mean colour of their primitive."""
STRETCH = 0.3
"""Weight of the distance along the primitive's normal when choosing the surface point that colours a voxel. With plain
distance, voxels below the surface take the deepest points: the corners of an eye instead of the iris."""
MIP_LEVELS = 6


@dataclasses.dataclass(frozen=True, eq=False)
class SurfaceField:
    """Density and texture lookup of each voxel: a payload without its colours, shared by recoloured meshes."""

    density: Float32[np.ndarray, "k s s s"]
    """1/m."""
    part: Int32[np.ndarray, "k s s s"]
    """Part of the nearest surface point; -1 beyond REACH."""
    uv: Float32[np.ndarray, "k s s s 2"]
    """Texture coordinates of that point, v up."""
    footprint: Float32[np.ndarray, "k s s s"]
    """Voxel size in texture coordinates at that point (1 = the whole texture)."""
    own: Float32[np.ndarray, "k s s s"]
    """Blend weight of the voxel's own colour against the mean of its primitive; 1 at the surface, 0 beyond REACH."""


def from_mesh(mesh: TexturedMesh, frames: Frames) -> Payload:
    """The payload with which primitives in `frames` look like `mesh`: `surface_field`, then `colour`.

    Raises:
        UnusableMesh, ValueError: as `surface_field`.
    """
    return colour(surface_field(mesh, frames), mesh)


def surface_field(mesh: TexturedMesh, frames: Frames) -> SurfaceField:
    """Density and nearest visible surface point for every voxel of `frames` (unbatched, in the pose of `mesh`).

    The mesh is rasterised from all sides except below. A voxel in front of the visible surface of any view is empty;
    the others are solid (space carving), with a density that rises from 0 at the surface to FULL_DENSITY at a depth of
    RAMP. Meshes need not be closed: hair and skirts may be single sheets.

    Raises:
        UnusableMesh: the mesh is empty or not finite.
        ValueError: the frames are batched or not finite.
    """
    soup = flatten(mesh)
    centres = voxel_centres(frames)
    views, drawn = look_around(soup)
    points = visible_points(soup, views, drawn)
    queries, shape = centres.reshape(-1, 3), centres.shape[:-1]
    axes = np.repeat(frames.rotation[:, :, 2].detach().cpu().numpy().astype(np.float32), S**3, axis=0)
    found = nearest(points.position, queries, axes, STRETCH, REACH)

    normals = points.normal[np.maximum(found.index, 0)].reshape(len(centres), -1, 3)
    through, across = _spacing(frames, normals)
    depth = np.where(found.index >= 0, found.distance - INSET * through, REACH)
    solid = carve(queries, views, drawn) > 0
    density = np.where(solid, FULL_DENSITY * np.clip(depth / RAMP, 0, 1), 0)
    point_uv, point_footprint = _texture_coordinates(soup, points.face, points.barycentric)
    chosen = np.maximum(found.along, 0)
    return SurfaceField(
        density=density.reshape(shape).astype(np.float32),
        part=np.where(found.along >= 0, soup.part[points.face[chosen]], -1).astype(np.int32).reshape(shape),
        uv=point_uv[chosen].reshape(*shape, 2),
        footprint=(point_footprint[chosen] * across).reshape(shape).astype(np.float32),
        own=np.clip(2 - 2 * found.distance / REACH, 0, 1).reshape(shape).astype(np.float32),
    )


def colour(field: SurfaceField, mesh: TexturedMesh) -> Payload:
    """The payload of `field` with the colours of `mesh`, which may differ from the field's mesh only in its textures.

    A voxel takes the mean of the texture over its footprint.
    """
    rgb = np.zeros((*field.part.shape, 3), np.float32)
    for number, part in enumerate(mesh.parts):
        where = field.part == number
        if where.any():
            rgb[where] = _sample(part.texture, field.uv[where], field.footprint[where])
    weight = field.own[..., None] + np.float32(1e-6)
    mean = (rgb * weight).sum((1, 2, 3), keepdims=True) / weight.sum((1, 2, 3), keepdims=True)
    rgb = field.own[..., None] * rgb + (1 - field.own[..., None]) * mean
    return Payload(
        rgb=torch.from_numpy(np.ascontiguousarray(np.moveaxis(rgb, -1, 1))),
        density=torch.from_numpy(field.density),
        delta_scale=torch.ones(len(field.density), 3),
    )


def voxel_centres(frames: Frames) -> Float32[np.ndarray, "k s s s 3"]:
    """World positions of the voxel centres in the order D, H, W, metres.

    Raises:
        ValueError: the frames are batched or not finite.
    """
    position, rotation, half_extent = (
        field.detach().cpu().double().numpy() for field in (frames.position, frames.rotation, frames.half_extent)
    )
    if position.ndim != 2:
        raise ValueError(f"frames.position has shape {position.shape}; give the frames of one body, [k, 3].")
    if not all(np.isfinite(field).all() for field in (position, rotation, half_extent)):
        raise ValueError("The frames hold NaN or infinite values: check the body they are attached to.")
    local = np.linspace(-1, 1, S)
    t, b, n = (rotation[:, None, :, axis] * (half_extent[:, axis, None] * local)[:, :, None] for axis in range(3))
    centres = position[:, None, None, None] + n[:, :, None, None] + b[:, None, :, None] + t[:, None, None, :]
    return centres.astype(np.float32)


def _spacing(
    frames: Frames, normal: Float32[np.ndarray, "k n 3"]
) -> tuple[Float32[np.ndarray, "kn"], Float32[np.ndarray, "kn"]]:
    """Voxel spacing along each normal of each primitive, and across it (geometric mean), metres."""
    pitch = frames.half_extent.detach().cpu().numpy()[:, None] * np.float32(2 / (S - 1))
    local = normal @ frames.rotation.detach().cpu().numpy().astype(np.float32)
    along = np.linalg.norm(local * pitch, axis=-1)
    across = np.sqrt(pitch.prod(-1) / np.maximum(along, 1e-9))
    return along.reshape(-1), across.reshape(-1)


def _texture_coordinates(
    soup: TriangleSoup, face: np.ndarray, barycentric: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates of surface points, and their scale in texture coordinates per metre."""
    uv = np.einsum("ni,nij->nj", barycentric, soup.corner_uv[face])
    corners = soup.vertices[soup.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    sides = soup.corner_uv[:, 1:] - soup.corner_uv[:, :1]
    uv_area = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    return uv.astype(np.float32), np.sqrt(uv_area / np.maximum(area, 1e-12))[face].astype(np.float32)


def _sample(
    texture: np.ndarray, uv: Float32[np.ndarray, "n 2"], footprint: Float32[np.ndarray, "n"]
) -> Float32[np.ndarray, "n 3"]:
    """Linear colour from the mip level whose texel size is closest to the footprint."""
    levels = mip_levels(texture, MIP_LEVELS)
    texels = footprint * np.sqrt(texture.shape[0] * texture.shape[1])
    level = np.clip(np.rint(np.log2(np.maximum(texels, 1e-6))), 0, len(levels) - 1).astype(np.int64)
    u, v = uv[:, 0] - np.floor(uv[:, 0]), 1 - (uv[:, 1] - np.floor(uv[:, 1]))
    rgb = np.zeros((len(uv), 3), np.float32)
    for number, image in enumerate(levels):
        at = np.flatnonzero(level == number)
        height, width = image.shape[:2]
        row = np.minimum((v[at] * height).astype(np.int64), height - 1)
        column = np.minimum((u[at] * width).astype(np.int64), width - 1)
        texel = image[row, column]
        rgb[at] = texel[:, :3] / np.maximum(texel[:, 3:], 1e-6)
    return rgb
