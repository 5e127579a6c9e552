"""How checkpoints hold a person prior: what follows from its symmetry and from few effects is left out."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from primdiffusion.diffusion.codec import LinearCodec
from primdiffusion.primitives.primitives import GRID

SYMMETRIC = 1e-4
"""Largest difference between an entry of a person component and its mirror image; entries are up to 1."""
RANK = 1e-5
"""Smallest singular value of the centres of kinds that is kept, as a share of the largest."""
MOST_CENTRES = 2**26
"""Most numbers that factors in a file may be multiplied out to."""


def store_prior(tensors: dict[str, Tensor], codec: LinearCodec) -> None:
    """Replace tensors of a prior, among those of a model, by smaller ones."""
    _store_half(tensors, codec)
    _store_effects(tensors)


def _store_half(tensors: dict[str, Tensor], codec: LinearCodec) -> None:
    """Keep the left half of each person component where the right one is its mirror image times its parity."""
    part, parity = tensors["denoiser.prior_part"], tensors["denoiser.prior_parity"]
    basis = tensors["denoiser.prior_basis"][:, part.argsort(stable=True).argsort()].mT
    half = basis.unflatten(2, (GRID, GRID))[..., : GRID // 2]
    if torch.allclose(_whole_components(half, part, parity, codec), basis, atol=SYMMETRIC):
        del tensors["denoiser.prior_basis"]
        tensors["denoiser.prior_basis_half"] = half


def _store_effects(tensors: dict[str, Tensor]) -> None:
    """Keep the centres of kinds, which are sums of few effects (`training.prior`), as a product of two factors."""
    centre = tensors["denoiser.prior_centre"].flatten(0, 1)
    kinds, size, effects = torch.linalg.svd(centre, full_matrices=False)
    rank = int((size > RANK * size[0]).sum())
    if rank * sum(centre.shape) < centre.numel():
        del tensors["denoiser.prior_centre"]
        root = size[:rank].sqrt()
        tensors["denoiser.prior_kinds"] = kinds[:, :rank] * root
        tensors["denoiser.prior_effects"] = root[:, None] * effects[:rank]


def restore_prior(weights: dict[str, Tensor], codec: LinearCodec) -> None:
    """Undo `store_prior` in the denoiser's tensors of a file.

    Raises ValueError, KeyError and RuntimeError for tensors that do not fit together.
    """
    if "prior_effects" in weights:
        kinds, effects = weights.pop("prior_kinds"), weights.pop("prior_effects")
        if len(kinds) * effects.shape[1] > MOST_CENTRES:
            raise ValueError(f"centres of kinds are {len(kinds)} times {effects.shape[1]} numbers")
        weights["prior_centre"] = (kinds @ effects).unflatten(0, weights["prior_log_weight"].shape)
    for name in ("prior_part", "prior_head"):
        weights[name] = weights[name].long()
    half, part = weights.pop("prior_basis_half", None), weights["prior_part"]
    if half is not None:
        if half.ndim != 4 or half.shape[2:] != (GRID, GRID // 2) or half.shape[1] > codec.channels:
            raise ValueError(f"halves of person components have shape {tuple(half.shape)}")
        whole = _whole_components(half, part, weights["prior_parity"], codec)
        weights["prior_basis"] = whole.mT[:, part.argsort(stable=True)].contiguous()


def _whole_components(
    half: Float[Tensor, "n d 32 16"], part: Int[Tensor, "k"], parity: Float[Tensor, "r"], codec: LinearCodec
) -> Float[Tensor, "n d k"]:
    left = torch.nn.functional.pad(half, (0, GRID // 2))
    if len(parity) % len(half) or not bool(((part >= 0) & (part < len(parity) // len(half))).all()):
        raise ValueError(f"{len(parity)} parities are not those of {len(half)} components of each part")
    signs = parity.unflatten(0, (-1, len(half)))[part].T.unflatten(1, (1, GRID, GRID))
    return (left + signs * codec.mirror(left)).flatten(2)
