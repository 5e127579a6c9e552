"""The surface that stands for a human's boxes until they are marched, and the part of a view that shows boxes."""

from __future__ import annotations

import numpy as np
import pytest

from blender_primdiffusion.engine.boxes import EDGE_PX, Boxes, seen_part
from blender_primdiffusion.engine.gpu.relief import VISIBLE, Relief, relief_of
from blender_primdiffusion.engine.view import PinholeView

pytestmark = pytest.mark.any_blender
THICK = 0.07
"""Metres between the first and the last voxel: each is 1 cm."""
RED, BLUE = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def box(*layers: tuple[slice, float, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Colour and density of one box whose layers along N, given as a slice, have this opacity a voxel."""
    rgb, density = np.zeros((1, 3, 8, 8, 8), np.float32), np.zeros((1, 8, 8, 8), np.float32)
    for where, opacity, colour in layers:
        density[0, where] = opacity / 0.01
        rgb[0, :, where] = colour[:, None, None, None]
    return rgb, density


def relief(*layers) -> Relief:
    return relief_of(*box(*layers), np.array([THICK]))


def middle(found: Relief) -> np.ndarray:
    """Vertices of the four columns next to the box's axis."""
    return np.flatnonzero((np.abs(found.place[:, :2]) < 0.2).all(1))


def test_the_surface_is_where_half_of_a_solid_is_above():
    found = relief((slice(0, 5), 1.0, RED))  # voxels at -1 to 1 / 7
    np.testing.assert_allclose(found.place[middle(found), 2], 2 / 7, atol=1e-4)
    turned = relief((slice(0, 5), 2.0, RED))
    np.testing.assert_allclose(turned.place[middle(turned), 2], 2.5 / 7, atol=1e-4)


def test_a_thin_layer_is_a_surface_at_its_place():
    found = relief((slice(3, 4), 0.6, RED))  # voxel 3 is at -1 / 7; half of .6 is above its middle
    np.testing.assert_allclose(found.place[middle(found), 2], 0.0, atol=1e-4)
    np.testing.assert_allclose(found.tint[middle(found)], [[*RED, 0.6]] * 4, atol=2e-3)


def test_colours_are_what_a_ray_from_outside_sees():
    opaque = relief((slice(0, 4), 1.0, BLUE), (slice(4, 6), 1.0, RED))
    np.testing.assert_allclose(opaque.tint[middle(opaque)], [[*RED, 1.0]] * 4, atol=1e-3)
    faint = relief((slice(0, 4), 1.0, BLUE), (slice(4, 5), 0.25, RED))
    np.testing.assert_allclose(faint.tint[middle(faint), :3], np.tile(0.25 * RED + 0.75 * BLUE, (4, 1)), atol=2e-3)


def test_nothing_is_drawn_of_what_is_hardly_visible():
    assert len(relief((slice(0, 8), 0.03, RED)).triangles) == 0
    whole = relief((slice(0, 8), 1.0, RED))
    assert len(whole.triangles) == 2 * 7 * 7, "the window leaves some of all cells"
    assert whole.tint[np.abs(whole.place[:, :2]).max(1) > 0.99, 3].max() < VISIBLE
    assert whole.triangles.max() == len(whole.place) - 1


def test_vertices_know_their_box():
    one, two = box((slice(0, 5), 1.0, RED)), box((slice(0, 5), 1.0, BLUE))
    nothing = box()
    rgb, density = (np.concatenate(parts) for parts in zip(one, nothing, two, strict=True))
    found = relief_of(rgb, density, np.full(3, THICK))
    assert set(found.box) == {0, 2}
    np.testing.assert_array_equal(found.tint[found.box == 2][:, 0], 0)
    assert (np.ptp(found.box[found.triangles], axis=1) == 0).all()


def boxes(*positions) -> Boxes:
    count = len(positions)
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(count, 3, 3)))
    return Boxes(np.array(positions, float), turn, np.full((count, 3), [0.1, 0.05, 0.02]))


def view(forward: float = 1.0) -> PinholeView:
    """Along z from the origin, or along -z."""
    intrinsics = np.array([[500.0, 0, 200], [0, 500.0, 150], [0, 0, 1]])
    turn = np.diag([forward, 1.0, forward])
    return PinholeView(intrinsics, np.concatenate([turn, np.zeros((3, 1))], 1), (0.1, 10.0), 400, 300)


def test_the_part_of_a_view_that_shows_boxes_holds_their_corners_and_little_else():
    shown = [boxes((0.1, 0.2, 2.0), (-0.3, 0.1, 3.0)), boxes((0.0, -0.1, 2.5))]
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    turned = [np.einsum("kij,ckj->kci", one.rotation, signs[:, None] * one.half_extent) for one in shown]
    corners = [one.position[:, None] + offsets for one, offsets in zip(shown, turned, strict=True)]
    points = np.concatenate([found.reshape(-1, 3) for found in corners])
    pixels = points[:, :2] / points[:, 2:] * 500 + [200, 150]
    left, bottom, right, top = seen_part(shown, view())
    low, high = np.array([left, 1 - top]) * [400, 300], np.array([right, 1 - bottom]) * [400, 300]
    assert (low + EDGE_PX <= pixels.min(0) + 1e-6).all()
    assert (high - EDGE_PX >= pixels.max(0) - 1e-6).all()
    assert np.abs([low - pixels.min(0), high - pixels.max(0)]).max() < 30


def test_boxes_around_or_behind_the_camera_may_be_anywhere_and_those_beside_the_view_leave_nothing():
    assert seen_part([boxes((0, 0, 0.05))], view()) == (0, 0, 1, 1)
    assert seen_part([boxes((0, 0, 2.0))], view(-1)) == (0, 0, 1, 1)
    left, bottom, right, top = seen_part([boxes((5.0, 0, 2.0))], view())
    assert (right - left) * (top - bottom) == 0
