"""Distances between two sets of samples from their features [n, d]; pure functions, computed in float64.

Finite sets of one distribution have a distance too: report the distance between two real sets beside them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

MIN_SAMPLES_PER_DIMENSION = 10
"""With fewer samples per feature, the bias of a Frechet distance is not small beside differences between models."""


def frechet_distance(first: Float[Tensor, "n d"], second: Float[Tensor, "m d"]) -> float:
    """Frechet distance |m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^1/2) of Gaussians fitted to both (Heusel et al. 2017).

    Covariances are unbiased; the distance is not: it falls with the number of samples, so compare sets of equal size.
    Raises ValueError for fewer than two samples or features of different widths.
    """
    check_features(first, second)
    means, roots = [], []
    for features in (first.double(), second.double()):
        means.append(features.mean(0))
        roots.append((features - means[-1]) / (len(features) - 1) ** 0.5)
    # tr (C1 C2)^1/2 is the nuclear norm of A1 A2^T, where C = A^T A: no square root of a singular matrix is needed.
    overlap = torch.linalg.svdvals(roots[0] @ roots[1].T).sum()
    spread = sum(root.square().sum() for root in roots)
    return float((means[0] - means[1]).square().sum() + spread - 2 * overlap)


def too_few_samples(first: int, second: int, features: int) -> str | None:
    """Warning for sample sizes that bias the Frechet distance; None for sets that are large enough."""
    fewest = MIN_SAMPLES_PER_DIMENSION * features
    if min(first, second) >= fewest:
        return None
    return (
        f"{min(first, second)} samples for {features} features are fewer than {MIN_SAMPLES_PER_DIMENSION} each "
        f"({fewest}): the distance is biased, so compare it only with those of sets of the same sizes"
    )


def cubic_kernel(first: Float[Tensor, "n d"], second: Float[Tensor, "m d"]) -> Float[Tensor, "n m"]:
    """(x.y / d + 1)^3 of every two samples."""
    return (first @ second.T / first.shape[1] + 1) ** 3


def kernel_distance(first: Float[Tensor, "n d"], second: Float[Tensor, "m d"]) -> float:
    """Squared maximum mean discrepancy with `cubic_kernel` (KID, Binkowski et al. 2018).

    The unbiased estimate over all samples: 0 on average for two sets of one distribution, so it can be negative. Raises
    ValueError as `frechet_distance`.
    """
    check_features(first, second)
    first, second = first.double(), second.double()
    within = 0.0
    for features in (first, second):
        table = cubic_kernel(features, features)
        within += float((table.sum() - table.trace()) / (len(features) * (len(features) - 1)))
    return within - 2 * float(cubic_kernel(first, second).mean())


class KernelDistances(NamedTuple):
    """The kernel distance over random subsets."""

    mean: float
    std: float
    """Standard deviation of the subsets' distances, biased, as published after +-."""


def kernel_distance_of_subsets(
    first: Float[Tensor, "n d"], second: Float[Tensor, "m d"], subsets: int, size: int, seed: int
) -> KernelDistances:
    """KID as torch-fidelity computes and draws it: `kernel_distance` of `subsets` random subsets of `size` samples.

    Raises ValueError as `frechet_distance`, and if a set has fewer than `size` samples.
    """
    check_features(first, second)
    if not 2 <= size <= min(len(first), len(second)) or subsets < 1:
        raise ValueError(
            f"{subsets} subsets of {size} do not fit sets of {len(first)} and {len(second)} samples: choose a subset "
            "size from 2 to the smaller set's"
        )
    draws = np.random.RandomState(seed)  # torch-fidelity draws from it
    distances = []
    for _ in range(subsets):
        chosen = [torch.from_numpy(draws.choice(len(one), size, replace=False)) for one in (first, second)]
        distances.append(kernel_distance(first[chosen[0]], second[chosen[1]]))
    return KernelDistances(float(np.mean(distances)), float(np.std(distances)))


def check_features(first: Tensor, second: Tensor) -> None:
    """Raise ValueError unless both are features [n, d] and [m, d], n, m > 1."""
    if first.ndim != 2 or second.ndim != 2 or first.shape[1] != second.shape[1] or min(len(first), len(second)) < 2:
        raise ValueError(
            f"features have shapes {tuple(first.shape)} and {tuple(second.shape)}: give [n, d] and [m, d], n, m > 1"
        )
