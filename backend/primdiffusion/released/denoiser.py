"""Validate the `diffusion.*` tensors and infer their U-Net's configuration; they load unchanged (SPEC 3, 6)."""

from __future__ import annotations

import functools
from collections.abc import Mapping

import torch
from torch import Tensor

from primdiffusion.diffusion.unet import PAPER, PAPER_WITH_ATTENTION, SlabUNet, UNetConfig
from primdiffusion.primitives.primitives import S
from primdiffusion.primitives.slab import CHANNELS_PER_LAYER
from primdiffusion.released.account import Entry
from primdiffusion.released.reading import ReleasedFileError

PREFIX = "diffusion."
SLAB_CHANNELS = S * CHANNELS_PER_LAYER


def unet_config(weights: Mapping[str, Tensor]) -> UNetConfig:
    """Infer the U-Net of these tensors (names without the prefix); the number of heads is the released 8.

    Attention levels are those with a transformer after their residual blocks: none in the released checkpoints, despite
    their configuration (SPEC 1.3). Raises ReleasedFileError if the names do not form a U-Net.
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
        raise ReleasedFileError(
            f"the levels of {PREFIX}input_blocks have {blocks} residual blocks, which must be equal: download the "
            "checkpoint again"
        )
    return UNetConfig(first[1], width, tuple(multipliers), blocks[0], tuple(sorted(attention)))


def account_denoiser(weights: Mapping[str, Tensor]) -> tuple[UNetConfig, list[Entry]]:
    """Infer the U-Net's configuration and validate its tensors (names without the prefix).

    Raises ReleasedFileError, naming a tensor that is missing, unknown, of a wrong shape, or not finite floating point.
    """
    config = max((PAPER, PAPER_WITH_ATTENTION), key=lambda known: _match_fraction(known, weights))
    if _match_fraction(config, weights) < 0.5:
        config = unet_config(weights)
    if config.slab_channels != SLAB_CHANNELS:
        raise ReleasedFileError(
            f"'{PREFIX}input_blocks.0.0.weight' takes {config.slab_channels} channels, but slabs of {S} layers have "
            f"{SLAB_CHANNELS}: this is not a checkpoint of 1024 primitives"
        )
    expected = _shapes(config)
    for name in expected:
        if name not in weights:
            raise ReleasedFileError(f"'{PREFIX}{name}' {expected[name]} is missing: download the checkpoint again")
    entries = []
    for name, value in weights.items():
        key, shape = f"{PREFIX}{name}", tuple(value.shape)
        if name not in expected:
            raise ReleasedFileError(f"unknown tensor {key!r} {shape} in the denoiser: {_OTHER}")
        if shape != expected[name]:
            raise ReleasedFileError(f"{key!r} has shape {shape}, not {expected[name]}: {_OTHER}")
        entries.append(Entry(key, "diffusion", shape, "imported", "as denoiser.*"))
    for name, value in weights.items():
        if not value.is_floating_point() or not torch.isfinite(value).all():
            raise ReleasedFileError(
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
        raise ReleasedFileError(f"{PREFIX}input_blocks is not a valid U-Net ({config}: {error}): {_OTHER}") from error


_OTHER = "the checkpoint is of another version of the released code, or damaged"


def _shape(weights: Mapping[str, Tensor], name: str) -> tuple[int, ...]:
    if name not in weights:
        raise ReleasedFileError(f"'{PREFIX}{name}' is missing: {_OTHER}")
    if weights[name].ndim != 4 or 0 in weights[name].shape:
        raise ReleasedFileError(f"'{PREFIX}{name}' has shape {tuple(weights[name].shape)}, not [o, i, 3, 3]: {_OTHER}")
    return tuple(weights[name].shape)
