"""Validate the twelve DDPM buffers stored with the weights: all follow from the noise schedule (SPEC 1.4, 6)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from primdiffusion.diffusion.schedule import SCHEDULES
from primdiffusion.released.account import Entry
from primdiffusion.released.reading import ReleasedFileError

SCHEDULE = "sqrt_linear"
"""Name of the released schedule in `SCHEDULES`."""
RELATIVE, ABSOLUTE = 1e-4, 1e-6
"""Tolerances for buffers computed in float32. The linear schedule differs by tens of per cent."""
SMALLEST_VARIANCE = 1e-20
"""Lower bound of the posterior variance, which is 0 at t = 0, before taking its logarithm."""


def buffers() -> dict[str, Tensor]:
    """Compute the buffers (Ho et al. 2020, eq. 4 and 7) under latent-diffusion's names, float64 [T]."""
    alpha_bar = SCHEDULES[SCHEDULE]().alpha_bar
    before = torch.cat([alpha_bar.new_ones(1), alpha_bar[:-1]])
    alpha = alpha_bar / before
    variance = (1 - alpha) * (1 - before) / (1 - alpha_bar)
    return {
        "betas": 1 - alpha,
        "alphas_cumprod": alpha_bar,
        "alphas_cumprod_prev": before,
        "sqrt_alphas_cumprod": alpha_bar.sqrt(),
        "sqrt_one_minus_alphas_cumprod": (1 - alpha_bar).sqrt(),
        "log_one_minus_alphas_cumprod": (1 - alpha_bar).log(),
        "sqrt_recip_alphas_cumprod": (1 / alpha_bar).sqrt(),
        "sqrt_recipm1_alphas_cumprod": (1 / alpha_bar - 1).sqrt(),
        "posterior_variance": variance,
        "posterior_log_variance_clipped": variance.clamp_min(SMALLEST_VARIANCE).log(),
        "posterior_mean_coef1": (1 - alpha) * before.sqrt() / (1 - alpha_bar),
        "posterior_mean_coef2": (1 - before) * alpha.sqrt() / (1 - alpha_bar),
    }


def check_buffers(found: Mapping[str, Tensor]) -> list[Entry]:
    """Validate the buffers. Raises ReleasedFileError, naming one that is missing or has a wrong shape or value."""
    entries = []
    for name, expected in buffers().items():
        if name not in found:
            raise ReleasedFileError(
                f"{name!r}, a buffer of the noise schedule, is missing: download the checkpoint again"
            )
        given = found[name]
        if given.shape != expected.shape:
            raise ReleasedFileError(
                f"{name!r} has shape {tuple(given.shape)}, not {tuple(expected.shape)}: the checkpoint was trained "
                "with another schedule"
            )
        # Some implementations set the logarithm at t = 0 to that of t = 1 (Nichol and Dhariwal 2021).
        given = given.double()
        if name == "posterior_log_variance_clipped" and torch.isclose(given[0], expected[1], rtol=RELATIVE):
            expected = torch.cat([expected[1:2], expected[1:]])
        if not torch.allclose(given, expected, rtol=RELATIVE, atol=ABSOLUTE):
            step = int((given - expected).abs().nan_to_num(torch.inf).argmax())
            raise ReleasedFileError(
                f"{name!r} is {given[step]:.6g} at step {step}, not {expected[step]:.6g} as in the released schedule "
                f"({SCHEDULE}, beta from 1e-4 to 2e-2): the checkpoint was trained with another schedule"
            )
        entries.append(Entry(name, "schedule", tuple(found[name].shape), "checked", f"equals {SCHEDULE}"))
    return entries
