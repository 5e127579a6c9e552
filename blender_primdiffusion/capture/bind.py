"""A surface without a skeleton on a body: weights from the body's nearest surface, and back to the body's rest."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import bpy
import numpy as np
from mathutils.bvhtree import BVHTree
from mathutils.kdtree import KDTree
from numpy.typing import NDArray

from ..files.regular_files import FileError
from ..formats.joints import JOINT_NAMES
from ..scene.armature import build_armature
from ..scene.convention import points_to_backend, points_to_blender
from .body import Body, blend, fit_surface, vertex_normals
from .registration import Registration, axis_name, register, scale_note
from .rigged import mesh_points
from .scan_files import Parameters, ScanFile, read_parameters

_FAR_M, _LOOSE_M = 0.10, 0.06
"""Mean distance beyond which a scan is not of this body; distance at which a point's nearest place means little."""
_EXACT_M = 0.003
_SMOOTHING = 40
_SAME_PLACE_M = 1e-5


@dataclasses.dataclass(frozen=True, eq=False)
class Bound:
    """The result of binding."""

    armature: bpy.types.Object
    betas: NDArray[np.float64]
    notes: list[str]


@dataclasses.dataclass(frozen=True, eq=False)
class ScanSurface:
    """All meshes of a scan as one, its points in one place joined, so that seams stay closed."""

    points: NDArray[np.float64]
    """[n, 3]."""
    normals: NDArray[np.float64]
    """[n, 3], unit or zero."""
    neighbours: NDArray[np.int64]
    """Pairs of points with an edge between them [E, 2], both ways, sorted by the first."""
    point_of: NDArray[np.int64]
    """The point of each vertex of the meshes, one mesh after the other [V]."""


def bind_static(
    context: bpy.types.Context, scan_file: ScanFile, body: Body, meshes: Sequence[bpy.types.Object]
) -> Bound:
    """Bind meshes to a new armature with the 24 joints and bring them to its T rest, metres, facing forward.

    The pose is that of the parameters beside the scan; the shape is theirs where it fits, and else fitted to the
    surface, for betas mean nothing on another body. Raises FileError where there are none or they do not fit.
    """
    parameters = read_parameters(scan_file)
    found = _register(scan_file, body, parameters, meshes)
    surface = _surface(meshes, found, parameters)
    betas, shift, shape_notes = _shape(body, parameters, surface, scan_file)
    posed, _, skinning = body.pose(betas, parameters.rotations, shift)
    weights, trust = surface_weights(surface, posed, body)
    rest = points_to_blender(unpose(surface.points, weights, skinning))
    armature = build_armature(f"{scan_file.name} rig", points_to_blender(body.rest(betas)[1]))
    context.scene.collection.objects.link(armature)
    start = 0
    for mesh in meshes:
        chosen = surface.point_of[start : start + len(mesh.data.vertices)]
        start += len(chosen)
        _attach(mesh, armature, rest[chosen], weights[chosen])
    context.view_layer.update()
    notes = [*parameters.notes, *_registration_notes(found), *shape_notes]
    notes.append(f"bound to the body by its nearest surface, {np.mean(trust < 0.2):.0%} of it loose")
    return Bound(armature, betas, notes)


def _register(scan_file: ScanFile, body: Body, parameters: Parameters, meshes) -> Registration:
    posed, _, _ = body.pose(_known(body, parameters.betas), parameters.rotations, np.zeros(3))
    posed = posed * parameters.scale + parameters.translation
    found = register(points_to_backend(mesh_points(meshes)), posed)
    if found.distance > _FAR_M * parameters.scale:
        reason = f"does not match {scan_file.parameters} (surface and body are {found.distance * 100:.0f} cm apart)"
        raise FileError(scan_file.path, reason, "check that they belong together and that the parameters are SMPL's")
    return found


def _registration_notes(found: Registration) -> list[str]:
    notes = [scale_note(found.scale)]
    up = found.rotation.T @ np.array([0.0, 1.0, 0.0])
    if not np.array_equal(found.rotation, np.eye(3)):
        notes.append(f"turned to meet its parameters: their y is its {axis_name(up)}")
    if found.shift.any():
        notes.append(f"moved by {np.linalg.norm(found.shift):.2f} m to meet its parameters")
    return [note for note in notes if note]


def _known(body: Body, betas: NDArray) -> NDArray[np.float64]:
    """The betas that the body has."""
    return np.asarray(betas, np.float64)[: body.shape_basis.shape[-1]]


def _surface(meshes: Sequence[bpy.types.Object], found: Registration, parameters: Parameters) -> ScanSurface:
    """The scan where the unscaled, unmoved body of its parameters is."""
    vertices = found.apply(points_to_backend(mesh_points(meshes)))
    vertices = (vertices - parameters.translation) / parameters.scale
    triangles, start = [], 0
    for mesh in meshes:
        mesh.data.calc_loop_triangles()
        corners = np.empty(3 * len(mesh.data.loop_triangles), np.int32)
        mesh.data.loop_triangles.foreach_get("vertices", corners)
        triangles.append(corners.reshape(-1, 3).astype(np.int64) + start)
        start += len(mesh.data.vertices)
    return join_surface(vertices, np.concatenate(triangles))


def join_surface(vertices: NDArray, triangles: NDArray) -> ScanSurface:
    """Vertices [V, 3] and triangles [F, 3] with vertices in one place as one point."""
    cells = np.round(vertices / _SAME_PLACE_M).astype(np.int64)
    _, first, point_of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    point_of = point_of.reshape(-1)
    faces, points = point_of[triangles], vertices[first]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    return ScanSurface(points, vertex_normals(points, faces), edges[edges[:, 0] != edges[:, 1]], point_of)


def _shape(body: Body, parameters: Parameters, surface: ScanSurface, scan_file: ScanFile):
    """Betas, shift and notes: the parameters' own shape, unless they are of another body: then one that is fitted.

    SMPL parameters found beside a scan are SMPL's; on the default body their pose holds and their shape does not.
    """
    betas = _known(body, parameters.betas)
    nearest = _nearest_on(surface)
    own = fit_surface(body, betas, parameters.rotations, np.zeros(3), nearest, rounds=0)
    trusted = _EXACT_M if body.name == "default" and parameters.body != body.name else _FAR_M
    if own.residual <= trusted:
        return own.betas, np.zeros(3), [f"shape of its parameters, {own.residual * 1000:.0f} mm off on average"]
    fit = fit_surface(body, np.zeros(0), parameters.rotations, np.zeros(3), nearest)
    if fit.residual > _FAR_M:
        reason = f"does not match {scan_file.parameters} (surface and body are {fit.residual * 100:.0f} cm apart)"
        raise FileError(scan_file.path, reason, "check that they belong together")
    note = f"shape of the {body.name} body fitted to its surface, {fit.residual * 1000:.0f} mm off on average"
    return fit.betas, fit.shift, [note]


def _nearest_on(surface: ScanSurface) -> Callable[[NDArray, NDArray], tuple[NDArray, NDArray]]:
    tree = KDTree(len(surface.points))
    for number, point in enumerate(surface.points):
        tree.insert(point, number)
    tree.balance()

    def nearest(points: NDArray, normals: NDArray) -> tuple[NDArray, NDArray]:
        found = np.array([tree.find(point)[1] for point in points])
        agreement = (surface.normals[found] * normals).sum(-1)
        distance = np.linalg.norm(surface.points[found] - points, axis=-1)
        return surface.points[found], np.where(agreement > 0.3, np.exp(-((distance / 0.15) ** 2)), 0.0)

    return nearest


def surface_weights(
    surface: ScanSurface, posed: NDArray, body: Body
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Skin weights [n, 24] of the surface's points, and how much the body says about each [n], 0 ... 1.

    A point takes the weights of the nearest place on the posed body that faces the same way, so that an arm beside the
    trunk stays an arm. Where that place is far, as under skirts and hair, weights come from the point's neighbours.
    """
    tree = BVHTree.FromPolygons(posed.tolist(), body.faces.tolist())
    normals = surface.normals
    face, place, distance, agreement = _nearest_faces(tree, surface.points, normals)
    if np.median(agreement) < 0:  # a surface turned inside out
        face, place, distance, agreement = _nearest_faces(tree, surface.points, -normals)
    corners = posed[body.faces[face]]
    weights = np.einsum("nc,ncj->nj", _barycentric(place, corners), body.skin_weights[body.faces[face]])
    trust = np.where(agreement > 0.2, np.exp(-((distance / _LOOSE_M) ** 2)), 0.0)
    return _smooth(weights, trust, surface.neighbours), trust


def _nearest_faces(tree: BVHTree, points: NDArray, normals: NDArray):
    face, place = np.zeros(len(points), np.int64), np.zeros((len(points), 3))
    distance, agreement = np.zeros(len(points)), np.zeros(len(points))
    for number, (point, normal) in enumerate(zip(points.tolist(), normals, strict=True)):
        where, facing, index, away = tree.find_nearest(point)
        cosine = float(normal @ facing)
        if cosine < 0.2:
            others = tree.find_nearest_range(point, away + _LOOSE_M)
            fitting = [other for other in others if float(normal @ other[1]) >= 0.2]
            if fitting:
                where, facing, index, away = min(fitting, key=lambda other: other[3])
                cosine = float(normal @ facing)
        face[number], place[number], distance[number], agreement[number] = index, where, away, cosine
    return face, place, distance, agreement


def _barycentric(points: NDArray, corners: NDArray) -> NDArray[np.float64]:
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    area = np.maximum((normal**2).sum(-1), 1e-30)
    u = (np.cross(c - b, points - b) * normal).sum(-1) / area
    v = (np.cross(a - c, points - c) * normal).sum(-1) / area
    weights = np.clip(np.stack([u, v, 1 - u - v], -1), 0, 1)
    return weights / weights.sum(-1, keepdims=True)


def _smooth(weights: NDArray, trust: NDArray, edges: NDArray) -> NDArray[np.float64]:
    """Weights mixed with the mean of the neighbours', the more the less a point is to be trusted."""
    rows, starts = np.unique(edges[:, 0], return_index=True)
    if len(rows) == 0:
        return weights
    counts = np.diff(np.append(starts, len(edges)))[:, None]
    heed = trust[edges[:, 1]][:, None] + 0.05
    totals = np.add.reduceat(heed, starts)
    own, mixed = trust[rows, None], np.array(weights)
    for _ in range(_SMOOTHING):
        mean = np.add.reduceat(mixed[edges[:, 1]] * heed, starts) / totals
        mixed[rows] = own * weights[rows] + (1 - own) * mean
    for _ in range(2):  # faces of the body are larger than those of a scan: no creases along their edges
        mixed[rows] = (mixed[rows] + np.add.reduceat(mixed[edges[:, 1]], starts) / counts) / 2
    return mixed / mixed.sum(-1, keepdims=True)


def unpose(points: NDArray, weights: NDArray, skinning: NDArray) -> NDArray[np.float64]:
    """Points [n, 3] of a posed surface at rest: the inverse of linear blend skinning.

    Where blending has flattened space, as it does where a limb is turned far, the joint with the most weight counts.
    """
    blended = blend(weights, skinning)
    flat = np.linalg.det(blended[..., :3]) < 0.2
    blended[flat] = skinning[weights[flat].argmax(1), :3]
    return np.linalg.solve(blended[..., :3], (points - blended[..., 3])[..., None])[..., 0]


def _attach(mesh: bpy.types.Object, armature: bpy.types.Object, rest: NDArray, weights: NDArray) -> None:
    """Make the mesh's vertices `rest` [V, 3] (Blender's axes, world) and let the armature move them."""
    mesh.animation_data_clear()
    mesh.shape_key_clear()
    mesh.modifiers.clear()
    mesh.vertex_groups.clear()
    mesh.parent = armature
    mesh.matrix_parent_inverse.identity()
    mesh.matrix_basis.identity()
    mesh.data.vertices.foreach_set("co", rest.astype(np.float32).ravel())
    custom = mesh.data.attributes.get("custom_normal")
    if custom is not None:  # normals of the pose it was scanned in
        mesh.data.attributes.remove(custom)
    mesh.data.shade_smooth()
    mesh.data.update()
    weights = np.where(weights < 1e-3, 0.0, weights)
    for joint, name in enumerate(JOINT_NAMES):
        group = mesh.vertex_groups.new(name=name)
        for vertex in np.flatnonzero(weights[:, joint]):
            group.add([int(vertex)], float(weights[vertex, joint]), "REPLACE")
    modifier = mesh.modifiers.new("Armature", "ARMATURE")
    modifier.object = armature
    modifier.use_deform_preserve_volume = False
