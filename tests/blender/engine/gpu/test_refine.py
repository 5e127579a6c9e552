"""A view that moves shows a whole picture at once, then finer ones, then antialiased; a slow GPU works in slices."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from blender_primdiffusion.engine.gpu.refine import (
    COARSENESS,
    REST_S,
    SAMPLES,
    SLICE_S,
    SLOW_SAMPLES,
    GpuRefinement,
    MarchRequest,
    jittered,
)
from blender_primdiffusion.engine.view import PinholeView

pytestmark = pytest.mark.any_blender
VIEW = PinholeView(np.eye(3), np.eye(3, 4), (0.1, 10.0), 640, 480)


class SlowGpu:
    """A clock that pictures turn forward: `pixel_s` seconds a pixel, and as much for each box in its way."""

    def __init__(self, pixel_s: float, boxes: Callable[[float], int] = lambda _height: 0):
        """`boxes` by the height in the picture, from 0 at the top to 1."""
        self.now, self.pixel_s, self.boxes, self.sizes, self.longest = 0.0, pixel_s, boxes, [], 0.0

    def begin(self, view: PinholeView, coarseness: int) -> OnePass:
        assert coarseness == VIEW.width // view.width
        self.sizes.append((view.width, view.height))
        return OnePass(self, view)

    def refine_to_the_end(self, refinement: GpuRefinement) -> list[tuple[int, int]]:
        """Coarseness and sample of the pictures that appear."""
        shown = []
        for _ in range(2000):
            if refinement.resting:
                return shown
            began = self.now
            if refinement.advance() and (refinement.shown.coarseness, refinement.shown.sample) not in shown:
                shown.append((refinement.shown.coarseness, refinement.shown.sample))
            self.longest = max(self.longest, self.now - began)
            self.now += 0.02
        raise AssertionError("it never rests")


class OnePass:
    def __init__(self, gpu: SlowGpu, view: PinholeView):
        rows = -(-view.height // 8)
        self._gpu, self._work = gpu, [8 * view.width * (1 + gpu.boxes(row / rows)) for row in range(rows)]

    def advance(self, work: float) -> bool:
        done = 0
        while self._work and (done == 0 or done + self._work[0] <= work):
            done += self._work.pop(0)
        self._gpu.now += done * self._gpu.pixel_s
        return not self._work

    def wait(self) -> None:
        pass


def request(gpu: SlowGpu, key: object) -> MarchRequest:
    return MarchRequest(key, VIEW, gpu.begin)


def refined(gpu: SlowGpu) -> tuple[GpuRefinement, list[tuple[int, int]]]:
    """A picture to its end, and what was shown on the way."""
    refinement = GpuRefinement(lambda: gpu.now)
    refinement.want(request(gpu, "a"))
    return refinement, gpu.refine_to_the_end(refinement)


def test_a_picture_is_refined_and_antialiased_when_nothing_moves():
    gpu = SlowGpu(1e-6)
    refinement, shown = refined(gpu)
    assert shown == [*((coarseness, 0) for coarseness in COARSENESS), *((1, n) for n in range(1, SAMPLES))]
    assert gpu.sizes[:4] == [(80, 60), (160, 120), (320, 240), (640, 480)]
    assert gpu.longest < 2 * SLICE_S
    assert not refinement.advance()


def test_a_fast_gpu_skips_what_it_does_not_need():
    _, shown = refined(SlowGpu(1e-7))
    assert shown[:3] == [(8, 0), (1, 0), (1, 1)]


def test_a_fast_gpu_marches_in_full_while_the_view_moves():
    gpu = SlowGpu(1e-9)
    refinement, _ = refined(gpu)
    for key in range(1, 4):
        refinement.want(request(gpu, key))
        assert refinement.advance()
        assert (refinement.shown.request.key, refinement.shown.coarseness) == (key, 1)
        assert not refinement.advance()  # not yet at rest
        gpu.now += REST_S / 2


@pytest.mark.parametrize("pixel_s", [1e-9, 1e-7, 1e-6, 2e-5, 5e-5])
def test_the_first_call_after_any_change_shows_a_whole_picture_of_the_new_view(pixel_s):
    gpu = SlowGpu(pixel_s)
    refinement = GpuRefinement(lambda: gpu.now)
    for key in range(20):
        refinement.want(request(gpu, key))
        began = gpu.now
        assert refinement.advance()
        assert gpu.now - began < 0.3
        assert (refinement.shown.request.key, refinement.shown.sample, refinement.fresh) == (key, 0, False)
        for _ in range(key):
            refinement.advance()  # marching, in a pause that ends at any moment
            gpu.now += 0.05


def test_a_gpu_that_has_become_slow_is_noticed_at_the_first_picture():
    gpu = SlowGpu(1e-7)
    refinement, _ = refined(gpu)
    gpu.pixel_s = 2e-6
    for key, coarseness in (("b", 1), ("c", 4)):
        refinement.want(request(gpu, key))
        began = gpu.now
        assert refinement.advance()
        assert refinement.shown.coarseness == coarseness
    assert gpu.now - began < 0.05


def test_while_a_view_moves_its_pictures_are_as_fine_as_the_gpu_is_fast():
    gpu, shown = SlowGpu(1e-7), []
    refinement = GpuRefinement(lambda: gpu.now)
    for key in range(8):
        gpu.pixel_s = 1e-7 if key < 4 else 1e-6
        refinement.want(request(gpu, key))
        refinement.advance()
        shown.append(refinement.shown.coarseness)
    assert shown == [8, 1, 1, 1, 1, 4, 4, 4]


def test_a_human_below_empty_rows_does_not_stall_the_window():
    gpu = SlowGpu(2e-7, lambda height: 40 if height > 0.5 else 0)
    refined(gpu)
    assert gpu.longest < 2 * SLICE_S


def test_a_slow_gpu_averages_fewer_pictures():
    _, shown = refined(SlowGpu(1e-5))
    assert shown[-1] == (1, SLOW_SAMPLES - 1)


def test_a_finer_picture_is_abandoned_when_the_view_moves():
    gpu = SlowGpu(5e-6)
    refinement = GpuRefinement(lambda: gpu.now)
    refinement.want(request(gpu, "a"))
    while not gpu.sizes or gpu.sizes[-1] != (640, 480):
        refinement.advance()
        gpu.now += REST_S
    refinement.want(request(gpu, "b"))
    refinement.advance()
    assert refinement.shown.request.key == "b"
    gpu.now += REST_S
    refinement.advance()
    assert gpu.sizes[-1] == (160, 120)


def test_an_equal_request_changes_nothing_and_rays_stay_in_their_pixels():
    gpu = SlowGpu(1e-6)
    refinement, _ = refined(gpu)
    refinement.want(request(gpu, "a"))
    assert refinement.resting
    assert jittered(VIEW, 0) is VIEW
    shifts = [jittered(VIEW, n).intrinsics[:2, 2] - VIEW.intrinsics[:2, 2] for n in range(SAMPLES)]
    assert np.abs(shifts).max() <= 0.5
    assert np.abs(np.mean(shifts, 0)).max() < 0.15
