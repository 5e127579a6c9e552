"""Sample the visible surface of a mesh by rasterising it from several sides, and find nearest surface points."""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int32

from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.primitives.primitives import Frames, Payload, S
from primdiffusion.raster.shade import Fragments, OrthographicView, TriangleSoup, draw, flatten, view_along
from primdiffusion.raster.textures import mip_levels

DIRECTIONS = (
    (0.0, 0.0, -1.0),
    (0.0, 0.0, 1.0),
    (-1.0, 0.0, 0.0),
    (1.0, 0.0, 0.0),
    (0.0, -1.0, 0.0),
    (-1.0, -0.3, -1.0),
    (1.0, -0.3, -1.0),
    (-1.0, -0.3, 1.0),
    (1.0, -0.3, 1.0),
    (0.0, -1.0, -1.0),
    (0.0, -1.0, 1.0),
)
"""View directions. None looks up: from below, the space between jacket and trousers would be carved away, and hems
would become holes."""

PIXEL = 0.003
"""Pixel size of these views, metres."""

FACING = 0.5
"""Cosine of the largest angle to the normal at which a view decides whether a point is covered."""
COVER = (0.005, 0.030)
"""A surface whose distance above a point is in this range (metres) covers it: more than the depth uncertainty of the
views, less than the distance to the next limb."""


@dataclasses.dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of the outer surface visible in at least one view, about one per pixel area."""

    position: Float32[np.ndarray, "n 3"]
    """Metres."""
    normal: Float32[np.ndarray, "n 3"]
    """Unit length, towards the viewer."""
    face: Int32[np.ndarray, "n"]
    """Face of the soup."""
    barycentric: Float32[np.ndarray, "n 3"]
    """Barycentric coordinates on the face."""


def look_around(soup: TriangleSoup) -> tuple[list[OrthographicView], list[Fragments]]:
    """Rasterise the mesh along all DIRECTIONS."""
    used = soup.vertices[np.unique(soup.faces)]
    bounds = np.stack([used.min(0), used.max(0)])
    views = [view_along(direction, bounds, PIXEL) for direction in DIRECTIONS]
    return views, [draw(soup, view) for view in views]


def visible_points(soup: TriangleSoup, views: list[OrthographicView], drawn: list[Fragments]) -> SurfacePoints:
    """Visible points, thinned to one per cube of side PIXEL: the one that faces its view most directly."""
    corners = soup.vertices[soup.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    face = np.concatenate([fragments.face[fragments.face >= 0] for fragments in drawn])
    barycentric = np.concatenate([fragments.barycentric[fragments.face >= 0] for fragments in drawn])
    directions = np.repeat(
        np.stack([view.direction for view in views]), [int((fragments.face >= 0).sum()) for fragments in drawn], axis=0
    )
    towards = -np.einsum("ni,ni->n", normals[face], directions)
    position = np.einsum("ni,nij->nj", barycentric, corners[face])
    cell = np.floor((position - position.min(0)) / PIXEL).astype(np.int64)
    key = (cell[:, 0] << 42) + (cell[:, 1] << 21) + cell[:, 2]
    order = np.lexsort((-np.abs(towards), key))
    keep = order[np.concatenate([[True], np.diff(key[order]) != 0])]
    outward = normals[face[keep]] * np.where(towards[keep] < 0, -1.0, 1.0)[:, None]
    bare = ~_covered(position[keep], outward, views, drawn)
    if not bare.any():
        bare[:] = True
    keep, outward = keep[bare], outward[bare]
    return SurfacePoints(
        position=position[keep].astype(np.float32),
        normal=outward.astype(np.float32),
        face=face[keep],
        barycentric=barycentric[keep],
    )


def _covered(
    position: Float64[np.ndarray, "n 3"],
    normal: Float64[np.ndarray, "n 3"],
    views: list[OrthographicView],
    drawn: list[Fragments],
) -> Bool[np.ndarray, "n"]:
    """Mark points that lie closely under another surface, by the view that faces them most directly.

    A view down a collar sees skin under cloth, whose colour must not bleed into the cloth.
    """
    facing = -(normal @ np.stack([view.direction for view in views]).T)
    best = facing.argmax(1)
    covered = np.zeros(len(position), bool)
    for number, (view, fragments) in enumerate(zip(views, drawn, strict=True)):
        at = np.flatnonzero((best == number) & (facing[:, number] > FACING))
        in_view = position[at] @ view.world_to_view[:, :3].T + view.world_to_view[:, 3]
        column, row = (in_view[:, :2] / view.pixel_size).astype(np.int64).T
        gap = in_view[:, 2] - fragments.depth[row, column]
        covered[at] = (gap > COVER[0]) & (gap < COVER[1])
    return covered


@dataclasses.dataclass(frozen=True, eq=False)
class NearestPoints:
    """Nearest points of each query in two metrics; -1 if no point is within reach."""

    index: Int32[np.ndarray, "q"]
    """The nearest point."""
    distance: Float32[np.ndarray, "q"]
    """Distance to that point, metres; inf if there is none."""
    along: Int32[np.ndarray, "q"]
    """Nearest point in the metric that weighs distance along the query's axis less."""


def nearest(
    points: Float32[np.ndarray, "n 3"],
    queries: Float32[np.ndarray, "q 3"],
    axes: Float32[np.ndarray, "q 3"],
    stretch: float,
    reach: float,
) -> NearestPoints:
    """Nearest points within `reach` metres; `along` scales distance along a query's unit axis by `stretch` (0 ... 1).

    Points are hashed into cubes of side `reach`, so a query searches 27 of them.
    """
    low = points.min(0)
    shape = np.floor((points.max(0) - low) / reach).astype(np.int64) + 1
    cube = np.floor((points - low) / reach).astype(np.int64)
    number = (cube[:, 0] * shape[1] + cube[:, 1]) * shape[2] + cube[:, 2]
    order = np.argsort(number, kind="stable")
    start = np.searchsorted(number[order], np.arange(shape.prod() + 1))
    result = NearestPoints(
        np.full(len(queries), -1, np.int32),
        np.full(len(queries), np.inf, np.float32),
        np.full(len(queries), -1, np.int32),
    )
    gain = np.float32(1 - stretch * stretch)
    _nearest(
        points[order], order, start, shape, low, np.float32(reach), queries, axes, gain,
        result.index, result.distance, result.along,
    )  # fmt: skip
    return result


@numba.njit(cache=True, nogil=True, fastmath=True)
def _nearest(points, order, start, shape, low, reach, queries, axes, gain, found, distance, along):
    for q in range(queries.shape[0]):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        cx, cy = int(np.floor((x - low[0]) / reach)), int(np.floor((y - low[1]) / reach))
        cz = int(np.floor((z - low[2]) / reach))
        ax, ay, az = axes[q, 0], axes[q, 1], axes[q, 2]
        best, best_squared = -1, reach * reach
        best_along, best_cost = -1, reach * reach
        z_from, z_to = max(cz - 1, 0), min(cz + 2, shape[2])
        if z_from >= z_to:
            continue
        for i in range(max(cx - 1, 0), min(cx + 2, shape[0])):
            for j in range(max(cy - 1, 0), min(cy + 2, shape[1])):
                row = (i * shape[1] + j) * shape[2]
                for n in range(start[row + z_from], start[row + z_to]):
                    dx, dy, dz = points[n, 0] - x, points[n, 1] - y, points[n, 2] - z
                    squared = dx * dx + dy * dy + dz * dz
                    if squared < best_squared:
                        best, best_squared = n, squared
                    if squared < reach * reach:
                        way = dx * ax + dy * ay + dz * az
                        cost = squared - gain * way * way
                        if cost < best_cost:
                            best_along, best_cost = n, cost
        if best >= 0:
            found[q] = order[best]
            distance[q] = np.sqrt(best_squared)
            along[q] = order[best_along]


def carve(
    queries: Float32[np.ndarray, "q 3"], views: list[OrthographicView], drawn: list[Fragments]
) -> Float32[np.ndarray, "q"]:
    """The least depth of each query behind the surface that a view sees, metres; negative if any view sees past it."""
    behind = np.full(len(queries), np.inf, np.float32)
    for view, fragments in zip(views, drawn, strict=True):
        _carve(queries, view.world_to_view.astype(np.float32), np.float32(view.pixel_size), fragments.depth, behind)
    return behind


@numba.njit(cache=True, nogil=True)
def _carve(queries, world_to_view, pixel_size, depth, behind):
    height, width = depth.shape
    m = world_to_view
    for q in range(queries.shape[0]):
        x, y, z = queries[q, 0], queries[q, 1], queries[q, 2]
        column = int(np.floor((m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / pixel_size))
        row = int(np.floor((m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / pixel_size))
        past = np.float32(-np.inf)
        if 0 <= column < width and 0 <= row < height:
            past = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3] - depth[row, column]
        behind[q] = min(behind[q], past)


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
        ValueError: as `surface_field`.
    """
    return colour(surface_field(mesh, frames), mesh)


def surface_field(mesh: TexturedMesh, frames: Frames) -> SurfaceField:
    """Density and nearest visible surface point for every voxel of `frames` (unbatched, in the pose of `mesh`).

    The mesh is rasterised from all sides except below. A voxel in front of the visible surface of any view is empty;
    the others are solid (space carving), with a density that rises from 0 at the surface to FULL_DENSITY at a depth of
    RAMP. Meshes need not be closed: hair and skirts may be single sheets.

    Raises:
        ValueError: the mesh is empty or not finite; the frames are batched or not finite.
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
