"""Validate a whole released checkpoint: every tensor is known, and none is missing (SPEC 6)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from torch import Tensor

from primdiffusion.diffusion.unet import UNetConfig
from primdiffusion.released import denoiser, stage_one
from primdiffusion.released.account import Account, Entry
from primdiffusion.released.reading import ReleasedFileError
from primdiffusion.released.schedule_buffers import buffers, check_buffers


@dataclasses.dataclass(frozen=True)
class Inventory:
    """A validated checkpoint."""

    account: Account
    unet: UNetConfig | None
    """Configuration of its denoiser; None for a stage-1 file, which has none."""


def take_inventory(weights: Mapping[str, Tensor]) -> Inventory:
    """Validate each tensor of a checkpoint of both stages (475 in the released one), or of stage 1 alone (165).

    Raises ReleasedFileError, naming the first tensor that is unknown, missing or invalid.
    """
    prefixes = (stage_one.PREFIX, denoiser.PREFIX)
    if not any(key.startswith(prefixes) for key in weights):
        if not any(key.partition(".")[0] in stage_one.TENSORS for key in weights):
            names = ", ".join(map(repr, list(weights)[:4])) or "none"
            raise ReleasedFileError(
                f"none of the {len(weights)} tensors belongs to a released checkpoint (first: {names}): give the "
                "authors' primdiffusion.pt"
            )
        return Inventory(Account(tuple(stage_one.account_stage_one(weights, prefix=""))), None)
    known = buffers()
    for key, value in weights.items():
        if key not in known and not key.startswith(prefixes):
            raise ReleasedFileError(f"unknown tensor {key!r} {tuple(value.shape)}: give the authors' primdiffusion.pt")
    entries = check_buffers({key: weights[key] for key in known if key in weights})
    entries += stage_one.account_stage_one(_under(weights, stage_one.PREFIX))
    unet, imported = denoiser.account_denoiser(_under(weights, denoiser.PREFIX))
    return Inventory(Account(_in_order(weights, entries + imported)), unet)


def _under(weights: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {key.removeprefix(prefix): value for key, value in weights.items() if key.startswith(prefix)}


def _in_order(weights: Mapping[str, Tensor], entries: list[Entry]) -> tuple[Entry, ...]:
    by_key = {entry.key: entry for entry in entries}
    assert by_key.keys() == weights.keys(), "every tensor has an entry"
    return tuple(by_key[key] for key in weights)
