"""An upright picture that turns towards the view's camera."""

from __future__ import annotations

import math

import gpu
import numpy as np
import pytest
from mathutils import Matrix

from blender_primdiffusion.engine.gpu import billboard
from blender_primdiffusion.engine.gpu.billboard import HEIGHT_M, corners, figure_of

PLACE = np.array([2.0, 3.0, 0.5])


def seen_from(*turns: tuple[float, str]) -> np.ndarray:
    """The view's matrix of a camera that looks down and is then turned about the world's axes, in degrees."""
    world = Matrix.Translation((1, -8, 2))
    for degrees, axis in turns:
        world = world @ Matrix.Rotation(math.radians(degrees), 4, axis)
    return np.array(world.inverted())


LEVEL = ((90, "X"),)
VIEWS = [LEVEL, ((40, "Z"), (75, "X")), ((-130, "Z"), (120, "X")), ((40, "Z"), (75, "X"), (30, "Z"))]


@pytest.mark.parametrize("turns", VIEWS, ids=str)
def test_a_picture_stands_upright_on_its_place_and_faces_the_camera(turns):
    to_view = seen_from(*turns)
    bottom_left, bottom_right, top_left, top_right = corners(PLACE, to_view, (0.1, 0.9), aspect=0.5)
    height = HEIGHT_M / 0.8
    for bottom, top in ((bottom_left, top_left), (bottom_right, top_right)):
        np.testing.assert_allclose(top - bottom, [0, 0, height], atol=1e-9)
    across = bottom_right - bottom_left
    assert np.linalg.norm(across) == pytest.approx(height / 2)
    assert across @ to_view[2, :3] == pytest.approx(0, abs=1e-9)
    assert across @ np.cross([0, 0, 1], to_view[2, :3]) > 0, "mirrored"
    middle = (bottom_left + bottom_right) / 2
    np.testing.assert_allclose(middle + np.array([0, 0, 0.1 * height]), PLACE, atol=1e-9)


def test_the_right_of_a_level_view_is_its_cameras():
    found = corners(PLACE, seen_from(*LEVEL), (0.0, 1.0))
    assert found[1][0] - found[0][0] == pytest.approx(HEIGHT_M)
    assert found[:, 1] == pytest.approx(PLACE[1])


def test_seen_from_above_the_picture_is_an_edge_along_the_views_right():
    found = corners(PLACE, seen_from((30, "Z")), (0.0, 1.0))
    right = [math.cos(math.radians(30)), math.sin(math.radians(30)), 0]
    np.testing.assert_allclose(found[1] - found[0], np.multiply(HEIGHT_M, right), atol=1e-6)


def test_the_figure_ends_where_its_opaque_rows_do():
    alpha = np.full((20, 10), 0.3)
    assert figure_of(alpha) == (0.0, 1.0)
    alpha[4:6, 3] = 0.9
    assert figure_of(alpha) == (0.0, 1.0), "too low to be a human"
    alpha[2:17, 5] = 0.9
    assert figure_of(alpha) == (0.1, 0.85)


@pytest.mark.skipif(not hasattr(gpu, "init"), reason="without a window Blender has a GPU context from 5.2 on")
def test_what_is_before_the_picture_hides_it_and_its_background_is_clear():
    try:
        gpu.init()
    except SystemError as error:
        pytest.skip(f"no GPU context: {error}")
    texture = billboard.texture_of(np.array([[[0.4, 0.2, 0.1, 1.0], [0.0, 0.0, 0.0, 0.0]]], np.float32))
    places = np.array([[-1.0, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]])
    for depth, left in ((0.9, [0.4, 0.2, 0.1]), (0.1, [0, 1, 0])):
        colour = gpu.types.GPUTexture((8, 8), format="RGBA16F")
        distance = gpu.types.GPUTexture((8, 8), format="DEPTH_COMPONENT32F")  # the buffer keeps no reference
        frame = gpu.types.GPUFrameBuffer(color_slots=colour, depth_slot=distance)
        with frame.bind(), gpu.matrix.push_pop(), gpu.matrix.push_pop_projection():
            gpu.matrix.load_matrix(Matrix.Identity(4))
            gpu.matrix.load_projection_matrix(Matrix.Identity(4))
            gpu.state.depth_mask_set(True)  # without it the depth is not cleared
            frame.clear(color=(0.0, 1.0, 0.0, 1.0), depth=depth)
            billboard.draw(texture, places)
            pixels = np.asarray(frame.read_color(0, 0, 8, 8, 4, 0, "FLOAT")).reshape(8, 8, 4)
        np.testing.assert_allclose(pixels[4, 1, :3], left, atol=0.02)
        np.testing.assert_allclose(pixels[4, 6, :3], [0, 1, 0], atol=0.02)
