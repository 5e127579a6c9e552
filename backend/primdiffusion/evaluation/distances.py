"""Distances between two sets of samples from their features [n, d]; pure functions, computed in float64.

Finite sets of one distribution have a distance too: report the distance between two real sets beside them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

MIN_SAMPLES_PER_DIMENSION = 10
"""With fewer samples per feature, the bias of a Frechet distance is not small beside differences between models."""
NEIGHBOURS = 3
"""k of precision and recall (Kynkäänniemi et al. 2019)."""
REDRAWS = 20
"""Bootstrap sets that the uncertainty of a distance is estimated from."""
ROWS_AT_ONCE = 512
"""Rows of a distance matrix computed at a time; limits memory, no effect on the result."""


def frechet_distance(first: Float[Tensor, "n d"], second: Float[Tensor, "m d"]) -> float:
    """Frechet distance |m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^1/2) of Gaussians fitted to both (Heusel et al. 2017).

    Covariances are unbiased; the distance is not: it falls with the number of samples, so compare sets of equal size.
    Raises ValueError for fewer than two samples or features of different widths.
    """
    _check(first, second)
    means, roots = [], []
    for features in (first.double(), second.double()):
        means.append(features.mean(0))
        roots.append((features - means[-1]) / (len(features) - 1) ** 0.5)
    # tr (C1 C2)^1/2 is the nuclear norm of A1 A2^T, where C = A^T A: no square root of a singular matrix is needed.
    overlap = torch.linalg.svdvals(roots[0] @ roots[1].T).sum()
    spread = sum(root.square().sum() for root in roots)
    return float((means[0] - means[1]).square().sum() + spread - 2 * overlap)


def frechet_uncertainty(first: Float[Tensor, "n d"], second: Float[Tensor, "m d"]) -> float:
    """Standard deviation of the Frechet distance when other samples are drawn: over REDRAWS bootstrap sets of `first`.

    A few samples far from the others move the distance by more than models differ.
    """
    generator = torch.Generator().manual_seed(0)
    redrawn = [torch.randint(len(first), (len(first),), generator=generator) for _ in range(REDRAWS)]
    return float(np.std([frechet_distance(first[chosen], second) for chosen in redrawn], ddof=1))


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
    _check(first, second)
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
    _check(first, second)
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


class PrecisionRecall(NamedTuple):
    """Fractions in [0, 1]; both are 1 for sets that cover each other."""

    precision: float
    """Fraction of generated samples within the real set."""
    recall: float
    """Fraction of real samples within the generated set."""


def precision_recall(made: Float[Tensor, "n d"], real: Float[Tensor, "m d"]) -> PrecisionRecall:
    """Improved precision and recall (Kynkäänniemi et al. 2019, eq. 1-2).

    A set is the union of balls around its samples, each reaching to the nearest neighbour of number NEIGHBOURS in that
    set. Raises ValueError for sets of as many or fewer.
    """
    _check(made, real)
    if min(len(made), len(real)) <= NEIGHBOURS:
        raise ValueError(
            f"sets of {len(made)} and {len(real)} samples are too small for {NEIGHBOURS} neighbours: use larger sets"
        )

    def covered(points: Tensor, centres: Tensor) -> float:
        own = torch.cdist(centres, centres).kthvalue(NEIGHBOURS + 1, dim=1).values  # the nearest is the sample itself
        return float((torch.cdist(points, centres) <= own).any(1).double().mean())

    made, real = made.double(), real.double()
    return PrecisionRecall(covered(made, real), covered(real, made))


class Nearest(NamedTuple):
    """The nearest neighbour of each query."""

    distance: Float[Tensor, "q"]
    index: Int[Tensor, "q"]


def nearest(
    queries: Float[Tensor, "q d"], among: Float[Tensor, "n d"], left_out: Bool[Tensor, "q n"] | None = None
) -> Nearest:
    """Find Euclidean nearest neighbours, except pairs `left_out`.

    Raises ValueError for an empty set or features of different widths.
    """
    if queries.shape[-1] != among.shape[-1] or not len(among):
        raise ValueError(f"queries {tuple(queries.shape)} do not match the set {tuple(among.shape)}: same width, n > 0")
    found = []
    for first in range(0, len(queries), ROWS_AT_ONCE):
        rows = slice(first, first + ROWS_AT_ONCE)
        table = torch.cdist(queries[rows].double(), among.double())
        found.append((table if left_out is None else table.masked_fill(left_out[rows], torch.inf)).min(1))
    return Nearest(torch.cat([part.values for part in found]), torch.cat([part.indices for part in found]))


def _check(first: Tensor, second: Tensor) -> None:
    if first.ndim != 2 or second.ndim != 2 or first.shape[1] != second.shape[1] or min(len(first), len(second)) < 2:
        raise ValueError(
            f"features have shapes {tuple(first.shape)} and {tuple(second.shape)}: give [n, d] and [m, d], n, m > 1"
        )
