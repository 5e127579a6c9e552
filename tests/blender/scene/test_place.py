"""Where a new human stands: near the 3D cursor, at its height, clear of humans and solid objects, and seen."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
import synthetic
from human_files import remove_human
from mathutils import Vector

from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.place import (
    GAP_M,
    REACH_M,
    _any_meets,
    _extent,
    _thinned,
    next_place,
    stand_at_cursor,
)

FRONT, BACK = Vector((8.0, -16.0, 9.0)), Vector((8.0, 16.0, 9.0))
"""Eyes; the first is about that of Blender's factory view."""


@pytest.fixture
def source(saved_scene, tmp_path):
    return synthetic.write(tmp_path / "human", 4)


def standing(source, eye=None) -> bpy.types.Object:
    """The armature of a new human at the cursor."""
    collection = build_human(bpy.context, source)
    stand_at_cursor(bpy.context, collection, eye)
    bpy.context.view_layer.update()
    return collection


def place(eye=None) -> list[float]:
    return next_place(bpy.context, eye).tolist()


def apart(extent, other) -> float:
    """Metres between two boxes in x or y, whichever is more."""
    return max(max(other[0][axis] - extent[1][axis], extent[0][axis] - other[1][axis]) for axis in (0, 1))


def test_the_place_of_the_next_human_is_foreseen(saved_scene, source):
    for location in ((1.0, -2.0, 0.3), (1.0, -2.0, 0.3), (0.2, -2.0, 0.0)):
        saved_scene.scene.cursor.location = location
        expected = next_place(saved_scene)
        collection = build_human(saved_scene, source)
        soles = collection.location.copy()
        stand_at_cursor(saved_scene, collection)
        moved = collection.location - soles
        np.testing.assert_allclose(expected, moved, atol=0.25)  # the synthetic human's arms are shorter
        assert expected[1:] == pytest.approx(location[1:])
        bpy.context.view_layer.update()


def test_a_human_stands_on_the_floor_beside_the_default_cube(saved_scene, source):
    bpy.ops.mesh.primitive_cube_add(size=2)
    free = build_human(saved_scene, source)
    soles = free.location.z
    remove_human(free)
    armature = standing(source)
    assert armature.location.z == pytest.approx(soles)
    assert apart(_extent(armature), ((-1, -1, -1), (1, 1, 1))) == pytest.approx(GAP_M, abs=1e-5)
    assert armature.location.x == 0
    assert -2 < armature.location.y < -1, "before it, which is nearest"


def test_the_second_human_stands_beside_the_first_and_clear_of_solid_objects(saved_scene, source):
    bpy.ops.mesh.primitive_cube_add(size=2)
    first = standing(source)
    bpy.ops.mesh.primitive_cube_add(size=0.5, location=(1.5, first.location.y, 0.3))
    second = standing(source)
    assert second.location.y == pytest.approx(first.location.y)
    assert apart(_extent(second), _extent(first)) >= GAP_M - 1e-5
    assert second.location.x < 0, "the other side is taken"


def hidden_in_view_layer(cube):
    cube.hide_set(True)


def hidden_everywhere(cube):
    cube.hide_viewport = True


def drawn_as_wire(cube):
    cube.display_type = "WIRE"


def below_the_feet(cube):
    cube.location.z = -0.95


def above_the_head(cube):
    cube.location.z = 3.2


def out_of_the_way(cube):
    cube.location.x = 2.1


@pytest.mark.parametrize(
    "change", [hidden_in_view_layer, hidden_everywhere, drawn_as_wire, below_the_feet, above_the_head, out_of_the_way]
)
def test_a_human_stands_at_the_cursor_where_nothing_is_in_the_way(empty_scene, change):
    bpy.ops.mesh.primitive_cube_add(size=2)
    assert place() != [0, 0, 0]
    change(bpy.context.object)
    assert place() == [0, 0, 0]


@pytest.mark.parametrize("kind", ["text_add", "primitive_bezier_circle_add"])
def test_curves_and_texts_are_in_the_way_too(empty_scene, kind):
    add = bpy.ops.object.text_add if kind == "text_add" else bpy.ops.curve.primitive_bezier_circle_add
    add(location=(0, 0, 1))
    bpy.context.object.data.extrude = 0.2
    assert place() != [0, 0, 0]


def test_instances_are_in_the_way(empty_scene):
    bpy.ops.mesh.primitive_cube_add(size=1, location=(50, 0, 0))
    group = bpy.data.collections.new("Group")
    group.objects.link(bpy.context.object)
    assert place() == [0, 0, 0]
    bpy.ops.object.collection_instance_add(collection="Group", location=(-50, 0, 0.5))
    assert place() != [0, 0, 0]


def test_inside_a_room_a_human_stays_clear_of_furniture_and_inside(empty_scene):
    bpy.ops.mesh.primitive_cube_add(size=1)
    room = bpy.context.object
    room.scale, room.location = (8, 8, 3), (0, 0, 1.5)
    bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 0, 0.4))
    bpy.context.view_layer.update()
    x, y, _ = place(Vector((3, -3, 2)))
    assert (x, y) != (0, 0)
    assert max(abs(x), abs(y)) < 3.5


def test_a_human_stands_where_the_eye_sees_them(empty_scene):
    bpy.ops.mesh.primitive_cube_add(size=2, location=(0, 0, 1))
    assert place(FRONT)[1] < -1
    bpy.ops.mesh.primitive_plane_add(size=40, location=(0, -1, 0), rotation=(np.pi / 2, 0, 0))
    assert place(BACK)[1] > 1, "behind the wall, where this eye is"


def test_a_human_within_a_closed_solid_is_moved_out_if_the_eye_is_outside(empty_scene):
    bpy.ops.mesh.primitive_cube_add(size=5)
    assert place(FRONT)[1] < -2.5
    assert place(Vector((2, 0, 1))) == [0, 0, 0], "inside as well"


def test_where_nothing_within_reach_is_free_a_human_stands_at_the_cursor(empty_scene):
    bpy.ops.mesh.primitive_plane_add(size=10 * REACH_M, location=(0, 0, 1))
    assert place() == [0, 0, 0]


def test_a_box_meets_a_triangle_where_no_plane_is_between_them():
    low, high = np.zeros(3), np.ones(3)
    through = np.array([[[-5, 0.5, 0.5], [5, 0.5, 0.4], [0.5, 5, 0.6]]], float)  # with no corner inside
    past_the_edge = np.array([[[2.2, 0, 0.5], [0, 2.2, 0.5], [2.2, 2.2, 0.5]]], float)  # its box overlaps
    inside = np.array([[[0.4, 0.4, 0.4], [0.5, 0.4, 0.4], [0.4, 0.5, 0.4]]])
    assert _any_meets(through, low, high)
    assert _any_meets(inside, low, high)
    assert not _any_meets(past_the_edge, low, high)
    assert not _any_meets(inside[:0], low, high)


def test_random_triangles_meet_a_box_as_dense_points_on_them_say():
    generator, low, high = np.random.default_rng(1), np.array([-0.5, -1, 0]), np.array([0.5, 1, 2])
    u = generator.dirichlet((1, 1, 1), 20000)
    for _ in range(60):
        corners = generator.uniform(-3, 3, (1, 3, 3))
        points = u @ corners[0]
        assert _any_meets(corners, low, high) >= ((points > low) & (points < high)).all(1).any()
        shrunk = _any_meets(corners, low + 0.1, high - 0.1)
        assert ((points > low) & (points < high)).all(1).any() >= shrunk


def test_a_meadow_costs_no_more_triangles_than_its_cells():
    generator = np.random.default_rng(2)
    blades = generator.uniform([0, 0, 0], [1, 1, 1], (5000, 1, 3)) + generator.uniform(0, 0.05, (5000, 3, 3))
    wall = np.array([[[0, 0, 0], [3, 0, 0], [0, 0, 3]]], float)
    thin = _thinned(np.concatenate([blades, wall]), np.zeros(3), np.ones(3))
    assert len(thin) <= 2 * 11**2 + 1
    assert _any_meets(thin, np.array([0.2, 0.2, 0]), np.array([0.25, 0.25, 1]))
    assert not _any_meets(thin, np.array([1.3, 0.2, 0]), np.array([1.4, 0.4, 1]))
    assert Vector(thin[0, 0]).to_tuple() == tuple(wall[0, 0])
