"""Which views show an object, how large and how much of it, and where a view must stand to hold humans."""

import math
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Vector

from blender_primdiffusion.jobs.views import _uncovered, fitted, share_between, share_of_height

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
def test_nothing_is_seen_behind_beside_and_around_the_eye(cube, eye):
    assert share_of_height(perspective(Vector(eye)), cube) == 0


def test_parallel_views_are_measured_too(cube):
    window = Matrix.Diagonal((1 / 2, 1 / 2, -0.01, 1)) @ Matrix.Rotation(math.radians(90), 4, "X")
    assert share_of_height(window, cube) == pytest.approx(0.25)


@pytest.mark.parametrize(("right", "share"), [(1.0, 1.0), (0.0, 0.5), (-0.5, 0.0)])
def test_what_lies_beside_the_uncovered_part_is_not_shown(cube, right, share):
    window = perspective(Vector((0, 0, 4.5)))  # the nearer face, from -1/4 to 1/4 of the view
    assert share_between(window, cube, np.array([-1.0, -1.0]), np.array([right, 1.0])) == pytest.approx(share)


def test_what_lies_outside_the_view_or_around_the_eye_is_not_shown(cube):
    all_of_it = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    half_outside = perspective(Vector((0, 0, 4.5)))
    half_outside[0][3] += 4.5  # the middle at the edge
    assert share_between(half_outside, cube, *all_of_it) == pytest.approx(0.5, abs=0.1)
    assert share_between(perspective(Vector((0, 0, 0.2))), cube, *all_of_it) == 0


PARALLEL = np.diag([1 / 4, 1 / 3, -0.01, 1.0])


@pytest.mark.parametrize("window", [np.array(perspective(Vector())), PARALLEL], ids=["perspective", "parallel"])
def test_the_view_that_is_found_holds_all_points_beside_the_panels_and_no_less(window):
    points = np.random.default_rng(0).uniform([-2, -1, -3], [3, 2, 1], (50, 3))
    low, high = np.array([-0.9, -0.8]), np.array([0.4, 0.7])
    centre, distance = fitted(window, points, low, high, 10.0)
    scale = np.diag([*[10.0 / distance] * 2, 1, 1]) if window[3, 3] else np.eye(4)
    eye = centre + np.array([0, 0, distance])
    clip = np.concatenate([points - eye, np.ones((50, 1))], 1) @ (scale @ window).T
    seen = clip[:, :2] / clip[:, 3:]
    assert (seen >= low - 1e-9).all()
    assert (seen <= high + 1e-9).all()
    filled = np.ptp(seen, axis=0) / (high - low)
    assert filled.max() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose((seen.min(0) + seen.max(0))[filled.argmax()] / 2, ((low + high) / 2)[filled.argmax()])


def region(kind: str, x: int, y: int, width: int, height: int, alignment: str = "NONE") -> SimpleNamespace:
    return SimpleNamespace(type=kind, x=x, y=y, width=width, height=height, alignment=alignment)


def test_panels_that_blender_draws_above_a_view_cover_it():
    main = region("WINDOW", 10, 20, 1000, 500)
    sidebar, toolbar = region("UI", 760, 20, 250, 460, "RIGHT"), region("TOOLS", 10, 20, 50, 460, "LEFT")
    header, hidden = region("HEADER", 10, 480, 1000, 40, "TOP"), region("ASSET_SHELF", 10, 20, 1, 1, "BOTTOM")
    last_operator = region("HUD", 60, 20, 200, 100, "FLOAT")
    area = SimpleNamespace(regions=[header, toolbar, sidebar, last_operator, main, hidden])
    low, high = _uncovered(area, main)
    np.testing.assert_allclose([low, high], [[-0.9, -1], [0.5, 0.84]])
    sidebar.x = 1010  # beside the view: panels without overlap
    assert _uncovered(area, main)[1][0] == 1
