"""Distances of sets of people, and the nearest training people."""

import itertools
import math

import numpy as np
import pytest
import scipy.linalg
import torch
from primdiffusion.evaluation.metrics import frechet_distance, kernel_distance
from support.errors import refused
from torchmetrics.image.kid import poly_mmd

from scripts.feature_space.comparison import frechet_uncertainty, nearest, nearest_other, precision_recall


def draws(count: int, width: int, seed: int, shift: float = 0.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    mixed = torch.randn(width, width, generator=torch.Generator().manual_seed(9))
    return torch.randn(count, width, generator=generator) @ mixed + shift


def test_frechet_distance_is_the_formula_with_scipys_matrix_root():
    first, second = draws(60, 8, 0), draws(50, 8, 1, shift=0.7)
    one, two = (np.cov(part.double().numpy(), rowvar=False) for part in (first, second))
    apart = first.double().mean(0) - second.double().mean(0)
    root = np.real(scipy.linalg.sqrtm(one @ two))
    expected = float(apart.square().sum()) + np.trace(one + two - 2 * root)
    assert frechet_distance(first, second) == pytest.approx(expected, rel=1e-9)


def test_frechet_distance_of_a_moved_set_is_the_square_of_the_move():
    people = draws(40, 5, 0)
    assert frechet_distance(people, people + 2.0) == pytest.approx(5 * 2.0**2, rel=1e-5)
    assert frechet_distance(people, people) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("count", [50, 800])
def test_the_uncertainty_is_the_spread_of_distances_of_other_samples(count):
    held = draws(400, 5, 1000)
    others = np.std([frechet_distance(draws(count, 5, seed), held) for seed in range(60)])
    assert frechet_uncertainty(draws(count, 5, 2000), held) == pytest.approx(others, rel=0.75)


def test_frechet_distance_needs_no_more_samples_than_features():
    few = draws(4, 20, 0)
    assert frechet_distance(few, few.flip(0)) == pytest.approx(0, abs=1e-9)


def test_kernel_distance_is_torchmetrics():
    first, second = draws(30, 6, 0).double(), draws(30, 6, 1, shift=0.5).double()
    assert kernel_distance(first, second) == pytest.approx(float(poly_mmd(first, second)), rel=1e-9)


def test_kernel_distance_of_sets_of_two_sizes_is_the_mean_over_pairs():
    first, second = draws(7, 3, 0).double(), draws(5, 3, 1, shift=0.5).double()

    def mean(pairs):
        kernels = [(float(a @ b) / 3 + 1) ** 3 for a, b in pairs]
        return sum(kernels) / len(kernels)

    within = mean(itertools.permutations(first, 2)) + mean(itertools.permutations(second, 2))
    across = mean(itertools.product(first, second))
    assert kernel_distance(first, second) == pytest.approx(within - 2 * across, rel=1e-9)


def test_kernel_distance_has_no_bias_and_frechet_distance_has():
    pairs = [(draws(12, 4, 2 * i), draws(12, 4, 2 * i + 1)) for i in range(200)]
    kernel = torch.tensor([kernel_distance(*pair) for pair in pairs])
    assert abs(float(kernel.mean())) < 3 * float(kernel.std()) / math.sqrt(len(pairs))
    assert min(frechet_distance(*pair) for pair in pairs) > 0


def test_precision_and_recall_tell_lost_variety_from_lost_quality():
    real = draws(200, 3, 0)
    centre = precision_recall(0.05 * draws(200, 3, 1), real)
    assert centre.precision > 0.95
    assert centre.recall < 0.2
    wide = precision_recall(torch.cat([draws(100, 3, 2), draws(100, 3, 3) + 100.0]), real)
    assert wide.precision == pytest.approx(0.5, abs=0.1)
    assert wide.recall > 0.8


def test_nearest_is_found_by_hand():
    found = nearest(torch.tensor([[0.0, 0.0], [5.0, 5.0]]), torch.tensor([[3.0, 4.0], [5.0, 6.0], [-1.0, 0.0]]))
    assert found.index.tolist() == [2, 1]
    assert found.distance.tolist() == [1.0, 1.0]


def test_nearest_other_is_of_another_geometry():
    features = torch.tensor([[0.0], [0.1], [5.0], [5.2]])
    found = nearest_other(features, torch.tensor([0, 0, 1, 1]))
    assert found.index.tolist() == [2, 2, 1, 1]


@pytest.mark.parametrize(
    ("first", "second"), [((1, 3), (4, 3)), ((4, 3), (4, 2)), ((4,), (4,))], ids=["one row", "widths", "flat"]
)
def test_sets_that_cannot_be_compared_are_named(first, second):
    for distance in (frechet_distance, kernel_distance):
        with refused(ValueError, "[n, d]"):
            distance(torch.zeros(first), torch.zeros(second))


def test_precision_needs_more_people_than_neighbours():
    with refused(ValueError, "3 neighbours"):
        precision_recall(draws(3, 2, 0), draws(9, 2, 1))
