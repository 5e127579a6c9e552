"""Which views show an object, and how large."""

import math

import bpy
import pytest
from mathutils import Matrix, Vector

from blender_primdiffusion.jobs.generate import share_of_height

FOCAL = 2.0
"""In half heights of the view, which spans as many metres as it is away."""


def perspective(eye: Vector) -> Matrix:
    """Of a square view from `eye` along -z."""
    near, far = 0.1, 100.0
    window = Matrix(
        (
            (FOCAL, 0, 0, 0),
            (0, FOCAL, 0, 0),
            (0, 0, (near + far) / (near - far), 2 * near * far / (near - far)),
            (0, 0, -1, 0),
        )
    )
    return window @ Matrix.Translation(-eye)


@pytest.fixture
def cube(empty_scene) -> bpy.types.Object:
    """One metre wide, around the origin."""
    bpy.ops.mesh.primitive_cube_add(size=1)
    bpy.context.view_layer.update()
    return bpy.context.object


def test_the_share_of_height_is_that_of_the_bounding_box(cube):
    assert share_of_height(perspective(Vector((0, 0, 4.5))), cube) == pytest.approx(0.25)  # the nearer face
    assert share_of_height(perspective(Vector((0, 0, 40.5))), cube) == pytest.approx(0.025)
    cube.scale = (1, 0.5, 1)
    bpy.context.view_layer.update()
    assert share_of_height(perspective(Vector((0, 0, 4.5))), cube) == pytest.approx(0.125)


@pytest.mark.parametrize("eye", [(0, 0, -4), (0, 0, 0.2), (30, 0, 4.5), (0, -30, 4.5)], ids=str)
def test_an_object_behind_beside_and_around_the_eye_is_not_shown(cube, eye):
    assert share_of_height(perspective(Vector(eye)), cube) == 0


def test_parallel_views_are_measured_too(cube):
    window = Matrix.Diagonal((1 / 2, 1 / 2, -0.01, 1)) @ Matrix.Rotation(math.radians(90), 4, "X")
    assert share_of_height(window, cube) == pytest.approx(0.25)
