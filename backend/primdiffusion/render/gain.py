"""How far exponential absorption is from the paper's rule, and the factor on density that brings it nearest."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from primdiffusion.formats.requests import DENSITY_GAIN
from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.march import MarchSettings, march

FAINT = 1e-4
"""Factor on density with which no ray of a person is ever full."""
MET = 1e-3
"""Rays with less opacity than this miss the person."""
SMALLEST_GAIN, LARGEST_GAIN = 0.1, 20.0


@dataclasses.dataclass(frozen=True)
class GainFit:
    """The gain that meets the paper's alpha best."""

    gain: float
    error: float
    """Mean difference of alpha over rays that meet the person, with this gain."""
    error_before: float
    """The same with DENSITY_GAIN."""
    rays: int
    """How many met the person."""


def unclamped_alpha(
    primitives: Primitives,
    camera: Camera,
    settings: MarchSettings = MarchSettings(),  # noqa: B008
) -> Float[Tensor, "h w"]:
    """The sum of all opacities along each ray, which the marcher's alpha is once clamped to 1 (SPEC 4).

    The marcher itself adds them: with a thousandth of the density no ray is ever full.
    """
    faint = dataclasses.replace(primitives, density=primitives.density * FAINT)
    return march(faint, camera, settings).alpha / FAINT


def fit_gain(reached: Float[ndarray, "n"]) -> GainFit:
    """The g that makes the mean of |(1 - exp(-g s)) - min(s, 1)| least, over rays with `unclamped_alpha` s >= MET.

    To one part in a thousand, between SMALLEST_GAIN and LARGEST_GAIN. Raises ValueError where no ray meets anything.
    """
    met = np.asarray(reached, np.float64).ravel()
    met = met[met >= MET]
    if len(met) == 0:
        raise ValueError("no ray meets the person: there is nothing to fit the gain to; generate the person again")

    def error(gain: float) -> float:
        return float(np.abs(-np.expm1(-gain * met) - np.minimum(met, 1)).mean())

    candidates = np.geomspace(SMALLEST_GAIN, LARGEST_GAIN, 100)
    for _ in range(2):
        best = int(np.argmin([error(gain) for gain in candidates]))
        candidates = np.geomspace(candidates[max(best - 1, 0)], candidates[min(best + 1, len(candidates) - 1)], 100)
    gain = float(candidates[int(np.argmin([error(gain) for gain in candidates]))])
    return GainFit(gain, error(gain), error(DENSITY_GAIN), len(met))
