"""Validate a whole checkpoint of the authors: every tensor is known, none is missing (SPEC 1.4, 3, 6).

The twelve DDPM buffers follow from the noise schedule, stage 1 is for `stage_one`, and the denoiser's tensors, from
which the configuration of the U-Net is inferred, load unchanged.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping

import torch
from torch import Tensor

from primdiffusion.diffusion.schedule import SCHEDULES
from primdiffusion.diffusion.unet import PAPER, PAPER_WITH_ATTENTION, SlabUNet, UNetConfig
from primdiffusion.files.tensor_file import under
from primdiffusion.primitives.primitives import CHANNELS_PER_LAYER, S
from primdiffusion.released import stage_one
from primdiffusion.released.imported import SCHEDULE
from primdiffusion.released.reading import Account, TensorEntry

RELATIVE, ABSOLUTE = 1e-4, 1e-6
"""Tolerances for buffers computed in float32. The linear schedule differs by tens of per cent."""
SMALLEST_VARIANCE = 1e-20
"""Lower bound of the posterior variance, which is 0 at t = 0, before taking its logarithm."""
PREFIX = "diffusion."
SLAB_CHANNELS = S * CHANNELS_PER_LAYER


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


def check_buffers(found: Mapping[str, Tensor]) -> list[TensorEntry]:
    """Validate the buffers. Raises ValueError, naming one that is missing or has a wrong shape or value."""
    entries = []
    for name, expected in buffers().items():
        if name not in found:
            raise ValueError(f"{name!r}, a buffer of the noise schedule, is missing: download the checkpoint again")
        given = found[name]
        if given.shape != expected.shape:
            raise ValueError(
                f"{name!r} has shape {tuple(given.shape)}, not {tuple(expected.shape)}: the checkpoint was trained "
                "with another schedule"
            )
        # Some implementations set the logarithm at t = 0 to that of t = 1 (Nichol and Dhariwal 2021).
        given = given.double()
        if name == "posterior_log_variance_clipped" and torch.isclose(given[0], expected[1], rtol=RELATIVE):
            expected = torch.cat([expected[1:2], expected[1:]])
        if not torch.allclose(given, expected, rtol=RELATIVE, atol=ABSOLUTE):
            step = int((given - expected).abs().nan_to_num(torch.inf).argmax())
            raise ValueError(
                f"{name!r} is {given[step]:.6g} at step {step}, not {expected[step]:.6g} as in the released schedule "
                f"({SCHEDULE}, beta from 1e-4 to 2e-2): the checkpoint was trained with another schedule"
            )
        entries.append(TensorEntry(name, "schedule", tuple(found[name].shape), "checked", f"equals {SCHEDULE}"))
    return entries


def infer_unet_config(weights: Mapping[str, Tensor]) -> UNetConfig:
    """Infer the U-Net of these tensors (names without the prefix); the number of heads is the released 8.

    Attention levels are those with a transformer after their residual blocks: none in the released checkpoints, despite
    their configuration (SPEC 1.3). Raises ValueError if the names do not form a U-Net.
    """
    first = _shape(weights, "input_blocks.0.0.weight")
    width, multipliers, blocks, attention = first[0], [], [0], set()
    number = 1
    while any(key.startswith(f"input_blocks.{number}.") for key in weights):
        if f"input_blocks.{number}.0.op.weight" in weights:
            blocks.append(0)
        else:
            channels = _shape(weights, f"input_blocks.{number}.0.out_layers.3.weight")[0]
            if blocks[-1] == 0:
                multipliers.append(channels // width)
            if f"input_blocks.{number}.1.proj_in.weight" in weights:
                attention.add(len(blocks) - 1)
            blocks[-1] += 1
        number += 1
    if len(multipliers) != len(blocks) or len(set(blocks)) != 1:
        raise ValueError(
            f"the levels of {PREFIX}input_blocks have {blocks} residual blocks, which must be equal: download the "
            "checkpoint again"
        )
    return UNetConfig(first[1], width, tuple(multipliers), blocks[0], tuple(sorted(attention)))


def account_denoiser(weights: Mapping[str, Tensor]) -> tuple[UNetConfig, list[TensorEntry]]:
    """Infer the U-Net's configuration and validate its tensors (names without the prefix).

    Raises ValueError, naming a tensor that is missing, unknown, of a wrong shape, or not finite floating point.
    """
    config = max((PAPER, PAPER_WITH_ATTENTION), key=lambda known: _match_fraction(known, weights))
    if _match_fraction(config, weights) < 0.5:
        config = infer_unet_config(weights)
    if config.slab_channels != SLAB_CHANNELS:
        raise ValueError(
            f"'{PREFIX}input_blocks.0.0.weight' takes {config.slab_channels} channels, but slabs of {S} layers have "
            f"{SLAB_CHANNELS}: this is not a checkpoint of 1024 primitives"
        )
    expected = _shapes(config)
    for name in expected:
        if name not in weights:
            raise ValueError(f"'{PREFIX}{name}' {expected[name]} is missing: download the checkpoint again")
    entries = []
    for name, value in weights.items():
        key, shape = f"{PREFIX}{name}", tuple(value.shape)
        if name not in expected:
            raise ValueError(f"unknown tensor {key!r} {shape} in the denoiser: {_OTHER}")
        if shape != expected[name]:
            raise ValueError(f"{key!r} has shape {shape}, not {expected[name]}: {_OTHER}")
        entries.append(TensorEntry(key, "diffusion", shape, "imported", "as denoiser.*"))
    for name, value in weights.items():
        if not value.is_floating_point() or not torch.isfinite(value).all():
            raise ValueError(
                f"'{PREFIX}{name}' has NaN or infinite values or is not floating point: download the checkpoint again"
            )
    return config, entries


def _match_fraction(config: UNetConfig, weights: Mapping[str, Tensor]) -> float:
    """Fraction of tensors that match a configuration; above one half, mismatches are reported as errors."""
    expected = _shapes(config)
    fitting = sum(name in weights and tuple(weights[name].shape) == shape for name, shape in expected.items())
    return fitting / max(len(expected), len(weights))


@functools.lru_cache(maxsize=4)
def _shapes(config: UNetConfig) -> dict[str, tuple[int, ...]]:
    try:
        with torch.device("meta"):
            return {name: tuple(value.shape) for name, value in SlabUNet(config).state_dict().items()}
    except (ValueError, RuntimeError) as error:  # from torch, for widths not divisible by groups or heads
        raise ValueError(f"{PREFIX}input_blocks is not a valid U-Net ({config}: {error}): {_OTHER}") from error


_OTHER = "the checkpoint is of another version of the released code, or damaged"


def _shape(weights: Mapping[str, Tensor], name: str) -> tuple[int, ...]:
    if name not in weights:
        raise ValueError(f"'{PREFIX}{name}' is missing: {_OTHER}")
    if weights[name].ndim != 4 or 0 in weights[name].shape:
        raise ValueError(f"'{PREFIX}{name}' has shape {tuple(weights[name].shape)}, not [o, i, 3, 3]: {_OTHER}")
    return tuple(weights[name].shape)


@dataclasses.dataclass(frozen=True)
class Inventory:
    """A validated checkpoint."""

    account: Account
    unet: UNetConfig | None
    """Configuration of its denoiser; None for a stage-1 file, which has none."""


def take_inventory(weights: Mapping[str, Tensor]) -> Inventory:
    """Validate each tensor of a checkpoint of both stages (475 in the released one), or of stage 1 alone (165).

    Raises ValueError, naming the first tensor that is unknown, missing or invalid.
    """
    prefixes = (stage_one.PREFIX, PREFIX)
    if not any(key.startswith(prefixes) for key in weights):
        if not any(key.partition(".")[0] in stage_one.TENSORS for key in weights):
            names = ", ".join(map(repr, list(weights)[:4])) or "none"
            raise ValueError(
                f"none of the {len(weights)} tensors belongs to a released checkpoint (first: {names:.120}): "
                "give the authors' primdiffusion.pt"
            )
        return Inventory(Account(tuple(stage_one.account_stage_one(weights, prefix=""))), None)
    if all(key.startswith(stage_one.PREFIX) for key in weights):
        return Inventory(Account(tuple(stage_one.account_stage_one(under(weights, stage_one.PREFIX)))), None)
    known = buffers()
    for key, value in weights.items():
        if key not in known and not key.startswith(prefixes):
            raise ValueError(f"unknown tensor {key!r} {tuple(value.shape)}: give the authors' primdiffusion.pt")
    entries = check_buffers({key: weights[key] for key in known if key in weights})
    entries += stage_one.account_stage_one(under(weights, stage_one.PREFIX))
    unet, imported = account_denoiser(under(weights, PREFIX))
    return Inventory(Account(_in_order(weights, entries + imported)), unet)


def _in_order(weights: Mapping[str, Tensor], entries: list[TensorEntry]) -> tuple[TensorEntry, ...]:
    by_key = {entry.key: entry for entry in entries}
    assert by_key.keys() == weights.keys(), "every tensor has an entry"
    return tuple(by_key[key] for key in weights)
