"""Where a new human stands: near the 3D cursor, at its height, clear of humans and solid objects, and seen; and what is
solid, with its triangles."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from .human import BODY_MARK, humans
from .proxy import PROXY_MARK
from .stand_in import STAND_IN

GAP_M = 0.2
"""Between the hands of two humans in the T pose, and to solid objects that a human avoids."""
REACH_M = 6.0
"""Of the search for a place clear of solid objects: a human whom none suits stays at the 3D cursor."""
_FLESH_M = 0.1
"""Around bones."""
_STEP_M = 0.1
"""What is no higher above the soles is stood on: floors, rugs, uneven ground."""
_NEW_EXTENT = np.array([[-0.97, -0.3, 0.0], [0.97, 0.12, 1.8]])
"""As `_extent`, of a new human of medium height at the world's origin."""
_SEEN_AT = (0.95, 0.6, 0.3)
"""Shares of the height: head, hips and knees, of which the eye should see one."""
_GRID_M = 0.5
_CELL_M = 0.1
"""Smaller triangles are taken together, so that a meadow costs no more than a floor."""
_MOST_TRIED = 600
"""Places that are compared with solid objects."""
_SEE_THROUGH = frozenset({"WIRE", "BOUNDS"})
_SOLID_TYPES = frozenset({"MESH", "CURVE", "SURFACE", "FONT", "META"})
_OF_HUMANS = (BODY_MARK, PROXY_MARK, STAND_IN)


def stand_at_cursor(context: bpy.types.Context, person: bpy.types.Object, eye: Vector | None = None) -> None:
    """Move a new human from the world's origin to the nearest place at the 3D cursor's height that nothing cuts and the
    `eye` [3] sees, along the world's x axis where others stand there. Evaluates the scene."""
    person.location += context.scene.cursor.location
    context.view_layer.update()
    person.location.xy += Vector(_move(context, _extent(person), _others(context.scene, person), eye))


def next_place(context: bpy.types.Context, eye: Vector | None = None) -> NDArray[np.float64]:
    """Where `stand_at_cursor` will put the soles of a human of medium height that is still to be built [3], metres."""
    place = np.array(context.scene.cursor.location, np.float64)
    place[:2] += _move(context, _NEW_EXTENT + place, _others(context.scene), eye)
    return place


def _move(context: bpy.types.Context, extent: NDArray, others: NDArray, eye: Vector | None) -> NDArray[np.float64]:
    """In x and y [2], metres: first clear of solid objects, then along x clear of humans too."""
    around = _Surroundings.of(context, extent, others, eye)
    away = _nearest(_ways_out(extent, around), extent, np.zeros((0, 2, 3)), around)
    row = extent + np.array([*away, 0.0])
    return away + _nearest(_along_the_row(row, others, around), row, others, around)


@dataclasses.dataclass(frozen=True)
class _Surroundings:
    """The visible solid objects around a place, above what one stands on, and an eye."""

    depsgraph: bpy.types.Depsgraph
    eye: Vector | None
    surface: NDArray[np.float64]
    """Triangles [F, 3, 3] in the world."""
    boxes: NDArray[np.float64]
    """Lowest and highest corner [N, 2, 3] of each object."""

    @classmethod
    def of(cls, context: bpy.types.Context, extent: NDArray, others: NDArray, eye: Vector | None) -> _Surroundings:
        depsgraph, row = context.evaluated_depsgraph_get(), np.concatenate([extent[None], others])
        low, high = row.min((0, 1)) - REACH_M, row.max((0, 1)) + REACH_M
        low[2], high[2] = extent[0, 2] + _STEP_M, extent[1, 2]
        parts, boxes = [np.zeros((0, 3, 3))], [np.zeros((0, 2, 3))]
        for corners in _solids(depsgraph, low, high):
            near = corners[((corners.min(1) <= high) & (corners.max(1) >= low)).all(1)]
            if len(near):
                parts.append(near)
                boxes.append(_box(corners)[None])
        surface = _thinned(np.concatenate(parts), low, high)
        return cls(depsgraph, eye, surface, np.concatenate(boxes))

    def cut(self, extent: NDArray[np.float64]) -> bool:
        """Whether the surface of an object enters this box [2, 3], above what one stands on."""
        return _any_meets(self.surface, extent[0] + np.array([0, 0, _STEP_M]), extent[1])

    def seen(self, extent: NDArray[np.float64]) -> bool:
        """Whether the eye, if there is one, sees head, hips or knees of a human in this box."""
        if self.eye is None:
            return True
        middle, (low, high) = extent.mean(0), extent[:, 2]
        points = (Vector((*middle[:2], low + share * (high - low))) for share in _SEEN_AT)
        return any(self._clear(point - self.eye) for point in points)

    def _clear(self, ray: Vector) -> bool:
        scene = self.depsgraph.scene
        return not scene.ray_cast(self.depsgraph, self.eye, ray.normalized(), distance=ray.length)[0]


def _nearest(
    moves: Iterable[tuple[float, float]], extent: NDArray, others: NDArray, around: _Surroundings
) -> NDArray[np.float64]:
    """The shortest of these moves in x and y [2] that is clear of all and seen; else that is clear of all; else of
    `others`; else none. Prefers +x and -y."""
    unseen = cut = None
    tried = 0
    for x, y in sorted(set(moves), key=lambda move: (round(float(np.hypot(*move)), 6), move[0] < 0, move[1] > 0)):
        moved = extent + np.array([x, y, 0.0])
        if _too_close(moved, others):
            continue
        cut = cut or (x, y)
        tried += 1
        if tried > _MOST_TRIED:
            break
        if around.cut(moved if x == y == 0 else moved + _GAP):
            continue
        if around.seen(moved):
            return np.array([x, y])
        unseen = unseen or (x, y)
    return np.array(unseen or cut or (0.0, 0.0))


_GAP = np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0]]) * (GAP_M - 1e-6)


def _ways_out(extent: NDArray, around: _Surroundings) -> Iterator[tuple[float, float]]:
    """Moves within reach: none, straight past each solid object, and a grid for those that are not convex."""
    yield 0.0, 0.0
    for box in around.boxes:
        yield from ((x, 0.0) for x in _past(extent[:, 0], box[:, 0]) if abs(x) <= REACH_M)
        yield from ((0.0, y) for y in _past(extent[:, 1], box[:, 1]) if abs(y) <= REACH_M)
    if len(around.boxes):
        steps = np.arange(-REACH_M, REACH_M + _GRID_M, _GRID_M).tolist()
        yield from ((x, y) for x in steps for y in steps if np.hypot(x, y) <= REACH_M)


def _along_the_row(extent: NDArray, others: NDArray, around: _Surroundings) -> Iterator[tuple[float, float]]:
    """Moves in x: none, past each human, and past each solid object that is within reach or in a row that long."""
    past = [x for other in others for x in _past(extent[:, 0], other[:, 0])]
    yield from ((x, 0.0) for x in (0.0, *past))
    farthest = max(map(abs, past), default=0.0) + REACH_M
    for box in around.boxes:
        yield from ((x, 0.0) for x in _past(extent[:, 0], box[:, 0]) if abs(x) <= farthest)


def _past(own: NDArray, other: NDArray) -> tuple[float, float]:
    """The moves after which an interval [2] lies GAP_M above and below another."""
    return float(other[1] + GAP_M - own[0]), float(other[0] - GAP_M - own[1])


def _too_close(extent: NDArray, others: NDArray) -> bool:
    """Whether a box [2, 3] is nearer than GAP_M in x to one of others [N, 2, 3] while they overlap in y."""
    gap = np.array([GAP_M - 1e-6, 0.0])
    (low, high), other = extent[:, :2], others[..., :2]
    return bool(((low < other[:, 1] + gap) & (other[:, 0] < high + gap)).all(1).any())


def _others(scene: bpy.types.Scene, but: bpy.types.Object | None = None) -> NDArray[np.float64]:
    """`_extent` [N, 2, 3] of the scene's humans except `but`, where they have bones."""
    found = [person for person in humans(scene) if person != but]
    return np.array([_extent(armature) for armature in found if armature.data.bones]).reshape(-1, 2, 3)


def _extent(armature: bpy.types.Object) -> NDArray[np.float64]:
    """Lowest and highest x, y and z in the world [2, 3] of the bones as posed, with a margin for flesh."""
    to_world = np.array(armature.matrix_world)
    bones = [(bone.head, bone.tail) for bone in armature.pose.bones if bone.bone.use_deform]
    ends = np.array(bones, np.float64).reshape(-1, 3) @ to_world[:3, :3].T + to_world[:3, 3]
    return np.array([ends.min(0) - _FLESH_M, ends.max(0) + _FLESH_M])


def _solids(depsgraph: bpy.types.Depsgraph, low: NDArray, high: NDArray) -> Iterator[NDArray[np.float64]]:
    """Corners [F, 3, 3] in the world of each visible object or instance whose bounds meet a box; not of humans."""
    meshes: dict[object, tuple[NDArray, NDArray]] = {}
    for instance in depsgraph.object_instances:
        obj = instance.object
        if not instance.show_self or not is_solid(obj) or obj.display_type in _SEE_THROUGH:
            continue
        matrix = np.array(instance.matrix_world, np.float64)
        bounds = np.array([list(corner) for corner in obj.bound_box]) @ matrix[:3, :3].T + matrix[:3, 3]
        if (bounds.min(0) > high).any() or (bounds.max(0) < low).any():
            continue
        key = (obj.data.as_pointer(), obj.original.as_pointer())
        if key not in meshes:
            meshes[key] = triangles_of(obj)[:2]
        vertices, triangles = meshes[key]
        if len(triangles):
            yield (vertices @ matrix[:3, :3].T + matrix[:3, 3])[triangles]


def _thinned(corners: NDArray, low: NDArray, high: NDArray) -> NDArray[np.float64]:
    """Triangles [F, 3, 3] of which small ones are replaced by two that cover their cell of a horizontal grid, once."""
    small = (np.ptp(corners, axis=1)[:, :2] < _CELL_M).all(1)
    cells = np.unique(np.floor(corners[small].mean(1)[:, :2] / _CELL_M), axis=0)[:, None] * _CELL_M
    square = np.array([[[0, 0], [1, 0], [0, 1]], [[1, 1], [0, 1], [1, 0]]]) * _CELL_M
    flat = (cells[:, None] + square).reshape(-1, 3, 2)
    middle = np.full((*flat.shape[:2], 1), (low[2] + high[2]) / 2)
    return np.concatenate([corners[~small], np.concatenate([flat, middle], 2)])


def _box(corners: NDArray) -> NDArray[np.float64]:
    """Lowest and highest [2, 3] of corners [F, 3, 3]."""
    return np.array([corners.min((0, 1)), corners.max((0, 1))])


def _any_meets(corners: NDArray, low: NDArray, high: NDArray) -> bool:
    """Whether a triangle [F, 3, 3] meets the box between `low` and `high` [3]: no axis separates them."""
    half, corners = (high - low) / 2, corners - (high + low) / 2
    corners = corners[((corners.min(1) <= half) & (corners.max(1) >= -half)).all(1)]
    edges = np.roll(corners, -1, 1) - corners
    normals = np.cross(edges[:, 0], edges[:, 1])[:, None]
    axes = np.concatenate([normals, np.cross(edges[:, :, None], np.eye(3)).reshape(-1, 9, 3)], 1)
    along = np.einsum("fcx,fax->fac", corners, axes)
    reach = np.abs(axes) @ half + 1e-9
    return bool(((along.min(2) <= reach) & (along.max(2) >= -reach)).all(1).any())


def is_solid(obj: bpy.types.Object) -> bool:
    """Whether an object has a surface and is no part of a human."""
    return obj.type in _SOLID_TYPES and not any(mark in obj for mark in _OF_HUMANS)


def triangles_of(obj: bpy.types.Object) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int32]]:
    """Vertices [V, 3] in the object's space, triangles [F, 3] and their material slots [F], where `is_solid`."""
    mesh = obj.data if obj.type == "MESH" else obj.to_mesh()
    if mesh is None:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros(0, np.int32)
    try:
        mesh.calc_loop_triangles()
        vertices = np.empty((len(mesh.vertices), 3), np.float32)
        mesh.vertices.foreach_get("co", vertices.ravel())
        triangles = np.empty((len(mesh.loop_triangles), 3), np.int32)
        mesh.loop_triangles.foreach_get("vertices", triangles.ravel())
        slots = np.empty(len(triangles), np.int32)
        mesh.loop_triangles.foreach_get("material_index", slots)
    finally:
        if obj.type != "MESH":
            obj.to_mesh_clear()
    return vertices, triangles, slots
