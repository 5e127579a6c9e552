"""A human's relief on the GPU covers what is marched, with its colours and depths, and hides as it does."""

from __future__ import annotations

import gpu
import numpy as np
import pytest
from engine_stage import STEP
from gpu_stage import boxes_of, pinhole, placed, read

from blender_primdiffusion.engine.gpu.march import GpuPayload
from blender_primdiffusion.engine.gpu.relief import ReliefPicture
from blender_primdiffusion.engine.view import NO_SURFACE_M


@pytest.fixture(scope="module")
def human(backend):
    """Payload with a relief, and boxes."""
    fields = placed(backend)
    boxes = boxes_of(fields)
    return GpuPayload(fields["rgb"], fields["density"], 2 * boxes.half_extent[:, 2]), boxes


def sketched(human, view, ends=None) -> tuple[np.ndarray, np.ndarray]:
    picture = ReliefPicture([(human[0].relief, human[1])], view, ends)
    return read(picture.colour, view), read(picture.depth, view)


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0])
def test_a_relief_shows_what_is_marched(marcher, human, angle):
    view = pinhole(human[1].position.mean(0), (3.0 * np.sin(angle), 0.3, 3.0 * np.cos(angle)), size=(160, 240))
    march = marcher.march([human], view, STEP)
    assert march.advance()
    assert march.done == 1.0
    wanted, far = read(march.colour, view), read(march.depth, view)
    shown, near = sketched(human, view)
    both, either = (wanted[..., 3] > 0.5) & (shown[..., 3] > 0.5), (wanted[..., 3] > 0.5) | (shown[..., 3] > 0.5)
    assert both.sum() > 2000
    assert both.sum() > 0.88 * either.sum()
    assert np.abs(near - far)[both].mean() < 0.02
    assert np.abs(shown - wanted)[both][:, :3].mean() < 0.06
    assert (near[shown[..., 3] == 0] == np.float32(NO_SURFACE_M)).all()


def test_of_a_march_that_is_not_complete_the_upper_part_can_be_shown(marcher, human):
    view = pinhole(human[1].position.mean(0), (0.0, 0.3, 3.0), size=(160, 240))
    march = marcher.march([human], view, STEP)
    assert march.done == 0.0
    assert not march.advance(1.0)
    assert march.done == 7.5 / 240, "eight rows, of which the last is mixed with the next where they are smoothed"


def test_a_relief_is_hidden_by_other_objects(human):
    middle = human[1].position.mean(0)
    view = pinhole(middle, (0.0, 0.0, 3.0), size=(80, 120))
    whole, _ = sketched(human, view)
    wall = np.full((view.height, view.width, 1), 100.0, np.float32)
    wall[: view.height // 2] = 2.0
    buffer = gpu.types.Buffer("FLOAT", wall.size, wall[::-1].ravel())  # the bottom row first
    ends = gpu.types.GPUTexture((view.width, view.height), format="R32F", data=buffer)
    hidden, _ = sketched(human, view, ends)
    half = view.height // 2
    assert whole[:half].any()
    assert not hidden[:half].any()
    assert np.array_equal(hidden[half:], whole[half:])
