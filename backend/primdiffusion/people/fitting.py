"""Fit and rig the pack's meshes on a body, and hide what others cover.

Body and clothes are skinned separately, so bending can push skin through cloth close to it. Two remedies, computed once
for each garment on the average body and valid for all bodies and poses:

- skin under cloth and far from every hem (along the body's surface) is removed;
- a strip of skin remains under the hem, because sleeves can be looked into, and is sunk below the cloth.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from trimesh import Trimesh
from trimesh.geometry import faces_to_edges
from trimesh.graph import connected_component_labels

from primdiffusion.geometry.textured_mesh import TexturedPart, vertex_normals
from primdiffusion.people.assets import Assets, ObjMesh, Proxy
from primdiffusion.people.base_mesh import BaseMesh
from primdiffusion.people.wardrobe import SKIRTS, Garment

JOINTS = 24
INFLUENCES = 4
"""Joints per vertex."""
DRAPE, LOOSE = 6, 0.6
"""Smoothing iterations of a skirt's weights, and the lower fraction of the skirt that is smoothed."""
OVERLAP = 0.012
"""Overlap of socks with trousers, metres."""
HEM_DEPTH = 0.02
"""Height above its hem at which a skirt is closed between the legs, metres."""


@functools.lru_cache(maxsize=64)
def item_skinning(
    assets: Assets, base: BaseMesh, path: str
) -> tuple[Int[np.ndarray, "V 4"], Float[np.ndarray, "V 4"], Float[np.ndarray, "V 3 3"]]:
    """Joints, weights and rotation of a mesh's vertices, blended from the base mesh; the four strongest joints."""
    proxy, mesh = assets.proxy(path)
    dense = np.zeros((len(base.template), JOINTS))
    np.add.at(dense, (np.arange(len(dense))[:, None], base.joint_index), base.joint_weight)
    blended = np.maximum(proxy.blend(dense), 0)
    if path in SKIRTS:
        blended = _draped(blended, mesh, SKIRTS[path])
    turn = np.einsum("vj,jab->vab", blended / blended.sum(1, keepdims=True), base.rest_from_native)
    index = np.argsort(-blended, axis=1, kind="stable")[:, :INFLUENCES]
    weight = np.take_along_axis(blended, index, axis=1)
    return index, weight / weight.sum(1, keepdims=True), turn


def _draped(weight: Float[np.ndarray, "V J"], mesh: ObjMesh, pieces: tuple[int, ...]) -> Float[np.ndarray, "V J"]:
    """Smooth a skirt's weights along the cloth: each half follows one thigh, and the middle would tear."""
    skirt = mesh.faces[np.isin(connected_faces(mesh.faces, len(weight)), pieces)]
    height = mesh.vertices[skirt, 1]
    edges = np.unique(np.sort(skirt[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    loose = mesh.vertices[:, 1:2] < height.min() + LOOSE * np.ptp(height)
    both = np.concatenate([edges, edges[:, ::-1]])
    count = np.bincount(both[:, 0], minlength=len(weight))[:, None]
    for _ in range(DRAPE):
        around = np.zeros_like(weight)
        np.add.at(around, both[:, 0], weight[both[:, 1]])
        weight = np.where(loose & (count > 0), 0.5 * weight + 0.5 * around / np.maximum(count, 1), weight)
    return weight


def fit_item(
    assets: Assets, base: BaseMesh, path: str, base_vertices: Float[np.ndarray, "B 3"]
) -> Float[np.ndarray, "V 3"]:
    """Fit a mesh to a body in the base's rest pose, metres."""
    return assets.proxy(path)[0].fit(base_vertices, item_skinning(assets, base, path)[2])


def skirt_faces(garment: Garment, mesh: ObjMesh) -> Bool[np.ndarray, " F"]:
    """Find the faces of a garment's skirt."""
    pieces = [number for number, piece in enumerate(garment.pieces) if piece.kind == "skirt"]
    return np.isin(connected_faces(mesh.faces, len(mesh.vertices)), pieces)


def lengthen(
    vertices: Float[np.ndarray, "V 3"], skirt: Int[np.ndarray, "F 3"], factor: float
) -> Float[np.ndarray, "V 3"]:
    """Stretch a skirt downwards from its waist."""
    own, result = np.unique(skirt), vertices.copy()
    waist = vertices[own, 1].max()
    result[own, 1] = waist - factor * (waist - vertices[own, 1])
    return result


def with_closed_hem(part: TexturedPart, skirt: Bool[np.ndarray, " F"]) -> TexturedPart:
    """Straighten a skirt's hem, and close it between the legs: rays that look into it would see the background."""
    faces = part.faces[skirt]
    sides = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1)  # each face's three edges
    edges = np.sort(sides.reshape(-1, 2), axis=1)
    _, place, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    height = part.vertices[sides, 1].mean(axis=-1)
    middle = (part.vertices[faces, 1].min() + part.vertices[faces, 1].max()) / 2
    hem = (count[place].reshape(-1, 3) == 1) & (height < middle)
    rim = sides[hem]
    uv = part.corner_uv[skirt][hem]
    own = np.unique(rim)
    dense = np.zeros(JOINTS)
    np.add.at(dense, part.skin_index[own], part.skin_weight[own])
    strongest = np.argsort(-dense, kind="stable")[:INFLUENCES]
    vertices = part.vertices.copy()
    hem_height = np.median(vertices[own, 1])
    vertices[own, 1] = hem_height
    below = np.unique(faces)
    vertices[below, 1] = np.maximum(vertices[below, 1], hem_height)
    centre = vertices[own].mean(axis=0) + np.array([0, HEM_DEPTH, 0])
    cap = np.column_stack([rim[:, ::-1], np.full(len(rim), len(part.vertices))])
    return dataclasses.replace(
        part,
        vertices=np.concatenate([vertices, centre[None]]),
        faces=np.concatenate([part.faces, cap.astype(part.faces.dtype)]),
        corner_uv=np.concatenate([part.corner_uv, np.repeat(uv[:, None], 3, axis=1)]),
        skin_index=np.concatenate([part.skin_index, strongest[None].astype(part.skin_index.dtype)]),
        skin_weight=np.concatenate([part.skin_weight, (dense[strongest] / dense[strongest].sum())[None]]),
    )


def under_hat(
    hat: Float[np.ndarray, "H 3"], hair: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> np.ndarray:
    """Find the hair faces under a hat ([F] bool): those whose centre is above the plane of its brim.

    The brim is the part farthest from the hat's centre; its plane is fitted, because hats are tilted.
    """
    middle = hat.mean(axis=0)
    radius = np.linalg.norm((hat - middle)[:, [0, 2]], axis=1)
    brim = hat[radius > 0.8 * radius.max()]
    design = np.column_stack([brim[:, 0], brim[:, 2], np.ones(len(brim))])
    slope_x, slope_z, height = np.linalg.lstsq(design, brim[:, 1], rcond=None)[0]
    centre = hair[faces].mean(axis=1)
    return centre[:, 1] > slope_x * centre[:, 0] + slope_z * centre[:, 2] + height


def skin_under_hem(
    outfit: Float[np.ndarray, "O 3"], socks: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> np.ndarray:
    """Find the sock faces under trousers ([F] bool): those above the outfit's lowest point. Skirts cover none."""
    return socks[faces].mean(axis=1)[:, 1] > outfit[:, 1].min() + OVERLAP


def shown_faces(
    base: BaseMesh, proxies: dict[str, tuple[Proxy, Int[np.ndarray, "F 3"]]], covered: Bool[np.ndarray, " B"]
) -> dict[str, np.ndarray]:
    """Find the visible faces of the body ("body") and of every proxy: [F] bool by name.

    From the outermost proxy inwards, each hides the base vertices it lists, on the body and on proxies below. A face is
    hidden if all its vertices are, so that a rim remains under the hem. `covered` vertices of the body are hidden too.
    """
    hidden = np.zeros(len(base.template), bool)
    shown: dict[str, np.ndarray] = {}
    for name, (proxy, faces) in sorted(proxies.items(), key=lambda item: -item[1][0].z_depth):
        shown[name] = ~proxy.hidden_by(hidden)[faces].all(axis=1)
        hidden[proxy.delete_vertices] = True
    shown["body"] = ~(hidden | covered)[base.faces].all(axis=1)
    return shown


def connected_faces(faces: Int[np.ndarray, "F 3"], vertex_count: int) -> Int[np.ndarray, " F"]:
    """Index of each face's connected component, largest first."""
    label = connected_component_labels(faces_to_edges(faces), vertex_count)[faces[:, 0]]
    order = np.argsort(-np.bincount(label), kind="stable")
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order))
    return rank[label]


def uv_islands(corner_uv: Float[np.ndarray, "F 3 2"]) -> Int[np.ndarray, " F"]:
    """Index of each face's UV island, largest first."""
    keys = np.rint(corner_uv.reshape(-1, 2) * 1e5).astype(np.int64)
    unique, index = np.unique(keys, axis=0, return_inverse=True)
    return connected_faces(index.reshape(-1, 3), len(unique))


REACH_OUT, REACH_IN = 0.045, 0.015
"""Largest distance of covering cloth outside the skin, and inside it, metres."""
STRIP = 0.012
"""Width of the strip of skin kept under a hem, metres."""
GAP_SHARE = 1.0
"""Additional width of the strip per metre of gap between skin and cloth: wide openings reveal more."""
SINK, CLEARANCE = 0.006, 0.003
"""Depth of the strip's inner edge, and of the strip below cloth that lies inside the skin, metres."""
GRID = 1e-4
"""Distances are rounded to this many metres before comparisons, so that results do not depend on the machine."""


@dataclasses.dataclass(frozen=True, eq=False)
class Cover:
    """Effect of one garment on the skin of the base mesh."""

    hidden: Bool[np.ndarray, " B"]
    """Vertices that are never visible."""
    sink: Float[np.ndarray, " B"]
    """Inward displacement of each vertex, metres."""


@functools.lru_cache(maxsize=32)
def cover(assets: Assets, base: BaseMesh, path: str) -> Cover:
    """Find what a garment covers by casting rays along the skin's normals of the average body. Takes one second."""
    vertices = base.template
    _, mesh = assets.proxy(path)
    skin = np.unique(base.faces)
    normal = vertex_normals(vertices, base.faces)[skin]
    corners = fit_item(assets, base, path, vertices)[mesh.faces]
    gap = np.full(len(vertices), np.inf)
    gap[skin] = _gaps(vertices[skin], normal, corners, REACH_OUT, REACH_IN)
    gap = np.round(gap / GRID) * GRID
    bare = np.zeros(len(vertices), bool)
    bare[skin] = np.isinf(gap[skin])
    if not bare.any():
        return Cover(~bare, np.zeros(len(vertices)))
    depth = np.round(_distance(base, vertices, bare) / GRID) * GRID
    strip = STRIP + GAP_SHARE * np.where(np.isfinite(gap), np.maximum(gap, 0), 0)
    covered = np.isfinite(gap)
    sink = np.where(covered, np.clip(depth / STRIP, 0, 1) * np.maximum(SINK, CLEARANCE - gap), 0)
    return Cover(covered & (depth > strip), sink)


def sink_below_cloth(
    vertices: Float[np.ndarray, "B 3"], base: BaseMesh, covers: tuple[Cover, ...]
) -> Float[np.ndarray, "B 3"]:
    """Sink the covered vertices of the body below its garments."""
    depth = np.max([garment.sink for garment in covers], axis=0)
    return vertices - depth[:, None] * vertex_normals(vertices, base.faces)


def _distance(base: BaseMesh, vertices: Float[np.ndarray, "B 3"], bare: Bool[np.ndarray, " B"]) -> np.ndarray:
    """Distance along edges from each vertex to the nearest bare one, metres; inf if unreachable."""
    mesh = Trimesh(vertices, base.faces, process=False)
    graph = coo_matrix((mesh.edges_unique_length, mesh.edges_unique.T), shape=(len(vertices), len(vertices))).tocsr()
    return dijkstra(graph, directed=False, indices=np.flatnonzero(bare), min_only=True)


@njit(cache=True)
def _gaps(origin: np.ndarray, direction: np.ndarray, corners: np.ndarray, out: float, inward: float) -> np.ndarray:
    """Signed distance from each point along its direction to the nearest triangle; inf if out of range."""
    gap = np.full(len(origin), np.inf)
    middle = (corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3
    for t in range(len(corners)):
        a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
        radius = 0.0
        for k in range(3):
            radius = max(radius, np.sum((corners[t, k] - middle[t]) ** 2))
        limit = (np.sqrt(radius) + out) ** 2
        ab, ac = b - a, c - a
        for i in range(len(origin)):
            x, y, z = origin[i, 0] - middle[t, 0], origin[i, 1] - middle[t, 1], origin[i, 2] - middle[t, 2]
            if x * x + y * y + z * z > limit:
                continue
            d = direction[i]
            p0, p1, p2 = d[1] * ac[2] - d[2] * ac[1], d[2] * ac[0] - d[0] * ac[2], d[0] * ac[1] - d[1] * ac[0]
            det = ab[0] * p0 + ab[1] * p1 + ab[2] * p2
            if abs(det) < 1e-14:
                continue
            s0, s1, s2 = origin[i, 0] - a[0], origin[i, 1] - a[1], origin[i, 2] - a[2]
            u = (s0 * p0 + s1 * p1 + s2 * p2) / det
            if u < 0 or u > 1:
                continue
            q0, q1, q2 = s1 * ab[2] - s2 * ab[1], s2 * ab[0] - s0 * ab[2], s0 * ab[1] - s1 * ab[0]
            v = (d[0] * q0 + d[1] * q1 + d[2] * q2) / det
            if v < 0 or u + v > 1:
                continue
            distance = (ac[0] * q0 + ac[1] * q1 + ac[2] * q2) / det
            if -inward < distance < out and abs(distance) < abs(gap[i]):
                gap[i] = distance
    return gap
