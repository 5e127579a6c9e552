"""Where a new human stands: near the 3D cursor, at its height, clear of humans and solid objects."""

from collections.abc import Callable

import bpy
import pytest
import synthetic
from human_files import remove_human

from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.place import GAP_M, REACH_M, posed_extent, stand_at_cursor


@pytest.fixture
def source(saved_scene, tmp_path):
    return synthetic.write(tmp_path / "human", 4)


def standing(source) -> bpy.types.Object:
    """A new human at the cursor."""
    human = build_human(bpy.context, source)
    stand_at_cursor(bpy.context, human)
    bpy.context.view_layer.update()
    return human


def apart(extent, other) -> float:
    """Metres between two boxes in x or y, whichever is more."""
    return max(max(other[0][axis] - extent[1][axis], extent[0][axis] - other[1][axis]) for axis in (0, 1))


def test_a_human_stands_on_the_floor_beside_the_default_cube(saved_scene, source):
    bpy.ops.mesh.primitive_cube_add(size=2)
    free = build_human(saved_scene, source)
    soles = free.location.z
    remove_human(free)
    armature = standing(source)
    assert armature.location.z == pytest.approx(soles)
    assert apart(posed_extent(armature), ((-1, -1, -1), (1, 1, 1))) == pytest.approx(GAP_M, abs=1e-5)
    assert armature.location.x == 0
    assert -2 < armature.location.y < -1, "before it, which is nearest"


def test_the_second_human_stands_beside_the_first_and_clear_of_solid_objects(saved_scene, source):
    bpy.ops.mesh.primitive_cube_add(size=2)
    first = standing(source)
    bpy.ops.mesh.primitive_cube_add(size=0.5, location=(1.5, first.location.y, 0.3))
    second = standing(source)
    assert second.location.y == pytest.approx(first.location.y)
    assert apart(posed_extent(second), posed_extent(first)) >= GAP_M - 1e-5
    assert second.location.x < 0, "the other side is taken"


CLEAR: dict[str, Callable] = {
    "hidden in the view layer": lambda cube: cube.hide_set(True),
    "hidden everywhere": lambda cube: setattr(cube, "hide_viewport", True),
    "drawn as wire": lambda cube: setattr(cube, "display_type", "WIRE"),
    "below the feet": lambda cube: setattr(cube.location, "z", -0.95),
    "above the head": lambda cube: setattr(cube.location, "z", 3.2),
    "out of the way": lambda cube: setattr(cube.location, "x", 2.5),
}


@pytest.mark.any_blender
@pytest.mark.parametrize("change", CLEAR)
def test_a_human_stands_at_the_cursor_where_nothing_is_in_the_way(saved_scene, source, change):
    bpy.ops.mesh.primitive_cube_add(size=2)
    CLEAR[change](bpy.context.object)
    assert tuple(standing(source).location) == (0, 0, 0)


@pytest.mark.any_blender
@pytest.mark.parametrize("kind", ["text_add", "primitive_bezier_circle_add"])
def test_curves_and_texts_are_in_the_way_too(saved_scene, source, kind):
    add = bpy.ops.object.text_add if kind == "text_add" else bpy.ops.curve.primitive_bezier_circle_add
    add(location=(0, 0, 1))
    bpy.context.object.data.extrude = 0.2
    assert tuple(standing(source).location) != (0, 0, 0)


def test_instances_are_in_the_way(saved_scene, source):
    bpy.ops.mesh.primitive_cube_add(size=1, location=(50, 0, 0))
    group = bpy.data.collections.new("Group")
    group.objects.link(bpy.context.object)
    bpy.ops.object.collection_instance_add(collection="Group", location=(-50, 0, 0.5))
    assert tuple(standing(source).location) != (0, 0, 0)


@pytest.mark.any_blender
def test_inside_a_room_a_human_stays_clear_of_furniture_and_inside(saved_scene, source):
    bpy.ops.mesh.primitive_cube_add(size=1)
    room = bpy.context.object
    room.scale, room.location = (8, 8, 3), (0, 0, 1.4)
    bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 0, 0.4))
    x, y, _ = standing(source).location
    assert (x, y) != (0, 0)
    assert max(abs(x), abs(y)) < 3.5


@pytest.mark.any_blender
def test_where_nothing_within_reach_is_free_a_human_stands_at_the_cursor(saved_scene, source):
    bpy.ops.mesh.primitive_plane_add(size=10 * REACH_M, location=(0, 0, 1))
    assert tuple(standing(source).location) == (0, 0, 0)


@pytest.mark.any_blender
def test_on_uneven_ground_humans_stand_side_by_side(saved_scene, source):
    bpy.ops.mesh.primitive_cube_add(size=1)
    bpy.context.object.scale = (60, 60, 1)  # half a metre above the soles, as a hill elsewhere would be
    first, second = standing(source), standing(source)
    assert tuple(first.location) == (0, 0, 0)
    assert apart(posed_extent(second), posed_extent(first)) == pytest.approx(GAP_M, abs=1e-5)
