"""Marched pictures in a 3D view: behind and before its objects, clipped, transparent, beneath bones in front."""

from types import SimpleNamespace

import gpu
import numpy as np
import pytest

from blender_primdiffusion.engine.gpu.composite import ViewLook, draw_picture, keep_bones
from blender_primdiffusion.engine.view import NO_SURFACE_M

SIZE = (32, 16)
METRES = 4.0
COLOUR = np.array([0.4, 0.2, 0.1, 1.0])
NEAR, FAR = 0.1, 100.0
PERSPECTIVE = np.array(
    [
        [1.5, 0, 0.1, 0],
        [0, 3, -0.2, 0],
        [0, 0, -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)],
        [0, 0, -1, 0],
    ]
)
PARALLEL = np.array([[0.5, 0, 0, 0.1], [0, 1, 0, -0.2], [0, 0, -2 / (FAR + FAR), 0], [0, 0, 0, 1]])


@pytest.fixture(scope="module", autouse=True)
def context():
    if not hasattr(gpu, "init"):
        pytest.skip("without a window Blender has a GPU context from 5.2 on")
    try:
        gpu.init()
    except SystemError as error:
        pytest.skip(f"no GPU context: {error}")


def texture(values: np.ndarray, kind: str) -> gpu.types.GPUTexture:
    flat = np.ascontiguousarray(values, np.float32).ravel()
    size = (values.shape[1], values.shape[0])
    return gpu.types.GPUTexture(size, format=kind, data=gpu.types.Buffer("FLOAT", flat.size, flat))


def marched(depth=METRES, colour=COLOUR) -> SimpleNamespace:
    """A picture of one colour and one depth, or of those given by pixel."""
    size = SIZE[::-1]
    return SimpleNamespace(
        colour=texture(np.broadcast_to(colour, (*size, 4)), "RGBA16F"),
        depth=texture(np.broadcast_to(depth, size), "R32F"),
    )


def window_depth(matrix: np.ndarray, metres: float) -> float:
    clip = matrix @ [0, 0, -metres, 1]
    return clip[2] / clip[3] / 2 + 0.5


def drawn(picture, look: ViewLook, behind: float = 1.0, before=None) -> np.ndarray:
    """RGBA [h, w, 4] of the picture over green, with depth `behind` in the buffer."""
    colour = gpu.types.GPUTexture(SIZE, format="RGBA16F")
    depth = gpu.types.GPUTexture(SIZE, format="DEPTH_COMPONENT32F")
    frame = gpu.types.GPUFrameBuffer(color_slots=colour, depth_slot=depth)
    with frame.bind():
        frame.clear(color=(0.0, 1.0, 0.0, 1.0), depth=behind)
        if before is not None:
            before()
        draw_picture(picture, look)
        pixels = np.asarray(frame.read_color(0, 0, *SIZE, 4, 0, "FLOAT"))
    return pixels.reshape(SIZE[1], SIZE[0], 4)


def shows(pixels: np.ndarray) -> np.ndarray:
    """Where the picture covers the green [h, w]."""
    return np.abs(pixels[..., :3] - COLOUR[:3]).max(-1) < 1e-3


@pytest.mark.parametrize("matrix", [PERSPECTIVE, PARALLEL], ids=["perspective", "parallel"])
def test_objects_hide_what_is_behind_them_and_nothing_else(matrix):
    look = ViewLook(matrix)
    assert shows(drawn(marched(), look)).all()
    assert shows(drawn(marched(), look, window_depth(matrix, METRES + 0.02))).all()
    assert not shows(drawn(marched(), look, window_depth(matrix, METRES - 0.02))).any()


def test_what_is_behind_the_middle_of_a_parallel_view_is_hidden_likewise():
    look = ViewLook(PARALLEL)
    assert shows(drawn(marched(-3.0), look, window_depth(PARALLEL, -2.9))).all()
    assert not shows(drawn(marched(-3.0), look, window_depth(PARALLEL, -3.1))).any()


def test_a_faint_rim_is_as_far_as_what_it_surrounds():
    depth = np.full(SIZE[::-1], NO_SURFACE_M)
    depth[:, :8] = METRES
    seen = drawn(marched(depth), ViewLook(PERSPECTIVE), window_depth(PERSPECTIVE, METRES + 1))
    assert shows(seen)[:, :9].all()
    assert not shows(seen)[:, 9:].any()


def test_overlays_behind_a_human_go_as_far_as_the_human_is_opaque():
    look, colour = ViewLook(PERSPECTIVE, erases=True), np.broadcast_to(COLOUR, (*SIZE[::-1], 4)).copy()
    colour[8:] *= 0.25
    colour[:, 16:] = 0.0  # no human
    seen = drawn(marched(colour=colour), look, window_depth(PERSPECTIVE, METRES + 1))
    overlay = np.array([0.0, 1.0, 0.0, 1.0])
    for part, left in ((seen[:8, :15], 0.0), (seen[8:, :15], 0.75), (seen[:, 17:], 1.0)):
        np.testing.assert_allclose(part, np.broadcast_to(left * overlay, part.shape), atol=2e-3)
    before = drawn(marched(), look, window_depth(PERSPECTIVE, METRES - 1))
    np.testing.assert_array_equal(before, np.broadcast_to(overlay, before.shape))


def test_bones_in_front_are_not_erased():
    bones = np.array([[[4.0, 8.0], [28.0, 8.0]]])
    look = ViewLook(PERSPECTIVE, erases=True)
    seen = drawn(marched(), look, before=lambda: keep_bones(bones, SIZE, 2.0, 3.0))
    assert seen[7:9, 4:28, 1].all()
    assert not seen[:5].any()


def test_xray_shows_humans_through_objects_and_objects_through_humans():
    look = ViewLook(PERSPECTIVE, opacity=0.25, xray=True)
    seen = drawn(marched(), look, window_depth(PERSPECTIVE, 1.0))
    np.testing.assert_allclose(
        seen[..., :3], 0.25 * COLOUR[:3] + np.array([0, 0.75, 0]) + np.zeros_like(seen[..., :3]), atol=2e-3
    )


def test_outside_of_the_cameras_picture_it_is_darkened():
    look = ViewLook(PERSPECTIVE, frame=(0.25, 0.0, 1.0, 0.5), darkening=0.5)
    seen = drawn(marched(), look)
    assert shows(seen)[:8, 8:].all()
    np.testing.assert_allclose(seen[:, :8, :3], np.broadcast_to(COLOUR[:3] / 2, (16, 8, 3)), atol=1e-3)
    np.testing.assert_allclose(seen[8:, :, :3], np.broadcast_to(COLOUR[:3] / 2, (8, 32, 3)), atol=1e-3)


def test_bones_in_front_stay_above_the_picture():
    bones = np.array([[[4.0, 8.0], [28.0, 8.0]]])
    seen = shows(drawn(marched(), ViewLook(PERSPECTIVE), before=lambda: keep_bones(bones, SIZE, 2.0, 3.0)))
    assert not seen[7:9, 4:28].any()
    assert not seen[6:10, 2:6].any()
    assert seen[:5].all()
    assert seen[11:].all()
    assert seen[10, 10:22].all()
