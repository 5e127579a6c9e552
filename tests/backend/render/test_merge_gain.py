"""The density gain of exponential renderers: what it is fitted to, and that it is the best one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from primdiffusion.formats.requests import DENSITY_GAIN
from primdiffusion.geometry.camera import look_at
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.march import march
from primdiffusion.render.merge import FAINT, fit_gain, unclamped_alpha


def pile(density: float) -> Primitives:
    """Three boxes in a row before the camera, each of one density."""
    position = torch.tensor([[0.0, 0.0, 0.0], [0.01, 0.0, 0.1], [0.0, 0.02, 0.2]])
    return Primitives(
        position,
        torch.eye(3).expand(3, 3, 3),
        torch.full((3, 3), 0.04),
        torch.full((3, 3, 8, 8, 8), 0.5),
        torch.full((3, 8, 8, 8), density),
    )


def test_alpha_is_what_is_unclamped_up_to_one():
    camera = look_at(torch.tensor([0.3, 0.2, 1.5]), torch.zeros(3), vertical_fov=0.2, width=24, height=24)
    for density in (2.0, 20.0, 200.0):
        primitives = pile(density)
        reached = unclamped_alpha(primitives, camera)
        torch.testing.assert_close(reached.clamp_max(1), march(primitives, camera).alpha, atol=2e-6, rtol=0)
    assert reached.max() > 20
    assert reached.max() * FAINT < 1


def test_no_other_gain_is_better():
    reached = np.random.default_rng(0).gamma(0.8, 1.5, 4000)
    fit = fit_gain(reached)
    met = reached[reached >= 1e-3]

    def error(gain: float) -> float:
        return np.abs(1 - np.exp(-gain * met) - np.minimum(met, 1)).mean()

    assert fit.error == pytest.approx(error(fit.gain), rel=1e-9)
    assert fit.error_before == pytest.approx(error(DENSITY_GAIN), rel=1e-9)
    assert fit.error <= min(error(gain) for gain in np.linspace(0.1, 20, 2000)) * 1.0005
    assert fit.rays == len(met)


@pytest.mark.parametrize(("reached", "gain"), [(0.01, 1.005), (0.5, 2 * np.log(2))])
def test_one_kind_of_ray_has_the_gain_that_meets_it(reached, gain):
    fit = fit_gain(np.full(10, reached))
    assert fit.gain == pytest.approx(gain, rel=2e-3)
    assert fit.error == pytest.approx(0, abs=1e-3)


def test_rays_that_miss_count_nothing():
    assert fit_gain(np.array([0.5, 0.0, 1e-5])) == fit_gain(np.array([0.5]))


def test_a_person_whom_no_ray_meets_is_rejected():
    with pytest.raises(ValueError, match="no ray hits"):
        fit_gain(np.zeros(5))
