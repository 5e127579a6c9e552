"""PCKh of joints and the error of depth (SPEC 7)."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

PCK_SHARE = 0.5
"""A joint is correct within this share of the head size: PCKh@0.5."""
FLAT = 1e-9
"""Variance, relative to the mean's square, below which a map is constant."""


def correct_joints(
    found: Float[Tensor, "k 2"], true: Float[Tensor, "k 2"], head_size: float, share: float = PCK_SHARE
) -> Bool[Tensor, "k"]:
    """Whether each joint is within `share` of the head size of the true one (PCKh, Andriluka et al. 2014).

    Raises ValueError for different shapes or a head size that is not positive.
    """
    if found.shape != true.shape or found.ndim != 2 or found.shape[-1] != 2:
        raise ValueError(f"joints have shapes {tuple(found.shape)} and {tuple(true.shape)}: give two of [k, 2]")
    if not head_size > 0:
        raise ValueError(f"the head size is {head_size} pixels: give the distance of two joints of the head")
    return (found - true).norm(dim=-1) <= share * head_size


def depth_error(
    inverted: Float[Tensor, "h w"], true_depth: Float[Tensor, "h w"], mask: Bool[Tensor, "h w"]
) -> float | None:
    """Mean squared difference of inverted depths inside the mask, after aligning means and standard deviations.

    Monocular networks predict inverted depth up to scale and offset, so both maps get mean 0 and variance 1 inside the
    mask: the error is 0 for a positive affine map of 1 / `true_depth`, and 2 (1 - correlation) in general, 2 for a map
    that is unrelated or constant. None where fewer than two pixels, or a flat surface, are left to compare.
    """
    seen = mask & torch.isfinite(true_depth) & (true_depth > 0) & torch.isfinite(inverted)
    if int(seen.sum()) < 2:
        return None
    true, ours = 1 / true_depth[seen].double(), inverted[seen].double()
    if float(true.var(correction=0)) <= FLAT * float(true.square().mean()):
        return None
    if float(ours.var(correction=0)) <= FLAT * float(ours.square().mean()):
        return 2.0
    return float((_standardised(true) - _standardised(ours)).square().mean())


def _standardised(values: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    return (values - values.mean()) / values.std(correction=0)
