"""Priors of people that are one part."""

import torch
from jaxtyping import Float
from primdiffusion.diffusion.gaussian import PersonPrior
from torch import Tensor


def of_whole_body(
    mean: Float[Tensor, "c h w"],
    basis: Float[Tensor, "r d"],
    parity: Float[Tensor, "r"],
    rest_variance: Float[Tensor, "c h w"],
    log_weight: Float[Tensor, "g m"],
    centre: Float[Tensor, "g m r"],
    axes: Float[Tensor, "g r r"],
    variance: Float[Tensor, "g r"],
    kind: Float[Tensor, "g m x"],
) -> PersonPrior:
    """One part, whose components are rows over whole channels, with one Gaussian for each group."""
    cells, groups = mean[0].numel(), len(log_weight)
    return PersonPrior(
        mean=mean, basis=basis.unflatten(1, (-1, cells)).mT.contiguous(),
        part=torch.zeros(cells, dtype=torch.int64), parity=parity, rest_variance=rest_variance,
        log_weight=log_weight, centre=centre, axes=axes, variance=variance, left=variance.new_zeros(groups),
        head=torch.zeros(log_weight.shape, dtype=torch.int64), head_axes=axes.new_zeros(1, 0, 0),
        head_variance=axes.new_zeros(1, 0), head_left=axes.new_zeros(1),
        shared=axes.new_zeros(groups, 0, len(parity)), head_shared=axes.new_zeros(1, 0, 0), kind=kind,
    )  # fmt: skip
