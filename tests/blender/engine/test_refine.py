"""When a viewport asks for what, without Blender: a clock, a child and frames that the test holds in its hands."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from blender_primdiffusion.formats.answers import DrawAnswer

from blender_primdiffusion.backend.drawing import Drawing
from blender_primdiffusion.backend.requests import RequestError
from blender_primdiffusion.engine.refine import COARSENESS, REST_S, Refinement, ViewRequest
from blender_primdiffusion.engine.view import PinholeView, view_from_matrices, without_scale

pytestmark = pytest.mark.any_blender

SIZE = (101, 80)


def wish(key: object, region=None) -> ViewRequest:
    view = PinholeView(np.diag([100.0, 100.0, 1.0]), np.eye(4)[:3], (0.1, 100.0), *SIZE)
    return ViewRequest(key, {"people": []}, view, region)


@pytest.fixture
def bench():
    """A refinement with everything it asked for in `asked`."""
    bench = SimpleNamespace(now=0.0, asked=[], frames=[])

    def draw(params):
        bench.asked.append(Drawing(params))
        return bench.asked[-1]

    def frame(name, width, height):
        bench.frames.append((name, width, height))
        return SimpleNamespace(path=Path(name), width=width, height=height)

    bench.refinement = Refinement(draw, frame, lambda: bench.now)
    return bench


def answer(bench, state="done", **facts) -> None:
    bench.asked[-1].become(state, **facts)


def test_at_rest_pictures_become_finer_until_they_are_whole(bench):
    bench.refinement.want(wish("a"))
    for coarseness in COARSENESS:
        bench.refinement.advance()
        assert bench.asked[-1].params["width"] == -(-SIZE[0] // coarseness)
        answer(bench)
        bench.now += REST_S
    assert bench.refinement.advance()
    assert bench.refinement.resting
    assert bench.refinement.shown.coarseness == 1
    assert len(bench.asked) == 3


def test_while_the_view_changes_only_coarse_pictures_are_requested_one_at_a_time(bench):
    for step in range(10):
        bench.refinement.want(wish(step))
        bench.refinement.advance()
        bench.now += 0.02
        if step % 3 == 2:
            answer(bench)
            bench.refinement.advance()
    assert {drawing.params["width"] for drawing in bench.asked} == {-(-SIZE[0] // COARSENESS[0])}
    assert sum(not drawing.finished for drawing in bench.asked) == 1
    assert all(drawing.cancel_asked_at is None for drawing in bench.asked)
    assert len(bench.asked) == 4


def test_a_new_wish_cancels_a_fine_picture_and_not_a_coarse_one(bench):
    bench.refinement.want(wish("a"))
    bench.refinement.advance()
    bench.refinement.want(wish("b"))
    assert bench.asked[0].cancel_asked_at is None
    answer(bench)
    bench.refinement.advance()
    answer(bench)
    bench.now += REST_S
    bench.refinement.advance()
    fine = bench.asked[-1]
    assert fine.params["width"] == -(-SIZE[0] // COARSENESS[1])
    bench.refinement.want(wish("c"))
    assert fine.cancel_asked_at is not None
    shown = bench.refinement.shown
    answer(bench, "cancelled")
    bench.refinement.advance()
    assert bench.refinement.shown is shown
    assert bench.asked[-1].params["width"] == -(-SIZE[0] // COARSENESS[0])


def test_the_displayed_frame_is_never_written_to(bench):
    bench.refinement.want(wish("a"))
    for step in range(12):
        bench.refinement.advance()
        shown = bench.refinement.shown
        if shown is not None and bench.asked and not bench.asked[-1].finished:
            assert bench.asked[-1].params["frame"] != str(shown.frame.path)
        answer(bench, "cancelled" if step % 4 == 1 else "done")
        if step % 3 == 0:
            bench.refinement.want(wish(step))
        bench.now += REST_S


def test_the_same_request_again_draws_nothing(bench):
    for _ in range(5):
        bench.refinement.want(wish("a"))
        bench.refinement.advance()
    assert len(bench.asked) == 1


def test_an_error_is_reported_once_and_another_request_is_tried(bench):
    bench.refinement.want(wish("a"))
    bench.refinement.advance()
    answer(bench, "failed", error=RequestError("no backend", "set it up", "environment"))
    assert bench.refinement.advance()
    assert bench.refinement.error == "No backend. Set it up."
    assert bench.refinement.resting
    assert not bench.refinement.advance()
    bench.refinement.want(wish("b"))
    assert bench.refinement.error == ""
    bench.refinement.advance()
    assert len(bench.asked) == 2


def test_a_child_that_died_is_replaced_once_before_the_user_is_reported(bench):
    bench.refinement.want(wish("a"))
    bench.refinement.advance()
    for _ in range(2):
        assert bench.refinement.error == ""
        answer(bench, "failed", error=RequestError("the child has died", "", "died"))
        bench.refinement.advance()
    assert len(bench.asked) == 2
    assert bench.refinement.error == "The child has died."
    bench.refinement.want(wish("b"))
    bench.refinement.advance()
    answer(bench)
    bench.refinement.advance()
    assert bench.refinement.shown.request.key == "b"
    bench.refinement.want(wish("c"))
    bench.refinement.advance()
    answer(bench, "failed", error=RequestError("the child has died", "", "died"))
    bench.refinement.advance()
    assert bench.refinement.error == ""


def test_where_drawing_is_fast_moving_pictures_become_finer_and_coarser_again_where_it_is_not(bench):
    widths = []
    for step, seconds in enumerate([0.004, 0.004, 0.004, 0.2, 0.2, 0.2]):
        bench.refinement.want(wish(step))
        bench.refinement.advance()
        widths.append(bench.asked[-1].params["width"])
        answer(bench, result=DrawAnswer(seconds=seconds))
    assert widths == [-(-SIZE[0] // coarseness) for coarseness in (4, 2, 1, 1, 2, 4)]


def test_leaving_cancels_what_is_under_way(bench):
    bench.refinement.want(wish("a"))
    bench.refinement.advance()
    bench.refinement.give_up()
    assert bench.asked[0].cancel_asked_at is not None


def test_a_border_asks_for_the_coarse_pixels_that_touch_it(bench):
    bench.refinement.want(wish("a", (10, 20, 41, 33)))
    bench.refinement.advance()
    x, y, width, height = bench.asked[0].params["region"]
    assert (x, y) == (2, 5)
    assert x + width >= 51 / 101 * 26
    assert y + height >= 53 / 4
    assert bench.frames == [("1", width, height)]
    assert x + width <= bench.asked[0].params["width"]


def perspective(left, right, bottom, top, near, far) -> np.ndarray:
    """OpenGL's frustum."""
    out = np.zeros((4, 4))
    out[0, 0], out[0, 2] = 2 * near / (right - left), (right + left) / (right - left)
    out[1, 1], out[1, 2] = 2 * near / (top - bottom), (top + bottom) / (top - bottom)
    out[2, 2], out[2, 3] = -(far + near) / (far - near), -2 * far * near / (far - near)
    out[3, 2] = -1
    return out


def parallel(left, right, bottom, top, near, far) -> np.ndarray:
    """OpenGL's orthographic projection."""
    out = np.diag([2 / (right - left), 2 / (top - bottom), -2 / (far - near), 1.0])
    out[:3, 3] = -(right + left) / (right - left), -(top + bottom) / (top - bottom), -(far + near) / (far - near)
    return out


@pytest.mark.parametrize("make", [perspective, parallel])
def test_a_point_lands_where_opengl_puts_it(make):
    projection = make(-0.12, 0.2, -0.07, 0.11, 0.1, 50.0) if make is perspective else make(-2, 3, -1.5, 1, -50.0, 50.0)
    rng = np.random.default_rng(0)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = turn, turn @ -(turn.T @ np.array([0.1, -0.2, 4.0]))
    point = turn.T @ (np.array([0.3, 0.2, -5.0]) - view[:3, 3])  # 5 m ahead, Blender's world
    clip = projection @ view @ np.append(point, 1)
    pixel = (clip[:2] / clip[3] + 1) / 2 * [200, 120]
    given = view_from_matrices(projection, view, (0.1, 50.0), (200, 120), point)
    backend = np.array([point[0], point[2], -point[1]])
    seen = given.intrinsics @ (given.world_to_camera @ np.append(backend, 1))
    np.testing.assert_allclose(seen[:2] / seen[2], [pixel[0], 120 - pixel[1]], atol=1e-6)
    assert seen[2] - given.depth_offset == pytest.approx(5.0)
    assert given.clip[0] - given.depth_offset == pytest.approx(0.1)


def test_half_as_many_pixels_see_the_same(bench):
    view = wish("a").view
    half = view.scaled(50, 40)
    point = np.array([0.3, 0.2, 1.0])
    np.testing.assert_allclose(
        (half.intrinsics @ point)[:2] / [50, 40], (view.intrinsics @ point)[:2] / [101, 80], atol=1e-12
    )


def test_a_cameras_scale_is_taken_off():
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ np.diag([2.0, 0.5, 7.0])
    np.testing.assert_allclose(without_scale(matrix)[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
