"""Regressions by cells: what shows an effect, what happens to look like it, and the variance of both."""

from __future__ import annotations

import pytest
import torch
from primdiffusion.diffusion.components import PersonComponents
from primdiffusion.training.regression import regress_cells

CELLS, CHANNELS = 3, 8
INSIDE = PersonComponents(
    torch.zeros(CHANNELS, 1, CELLS),
    torch.eye(CELLS * CHANNELS).unflatten(1, (CELLS, CHANNELS)),
    torch.zeros(CELLS, dtype=torch.int64),
    torch.ones(CELLS * CHANNELS),
)
"""A component for each channel of each of three cells."""


def people(count, seed):
    """The first cell follows the design, the second half, the third not at all."""
    generator = torch.Generator().manual_seed(seed)
    design = torch.randn(count, 2, generator=generator)
    effect = torch.randn(2, CELLS, CHANNELS, generator=generator) * torch.tensor([2.0, 0.5, 0.0])[:, None]
    noise = torch.randn(count, CELLS, CHANNELS, generator=generator)
    return (torch.einsum("nq,qkd->nkd", design, effect) + noise).flatten(1), design, effect.flatten(1)


def test_cells_that_follow_the_design_keep_their_effect_and_others_have_next_to_none():
    c, design, effect = people(60, 0)
    shown, _ = regress_cells(c, design, INSIDE)
    shown, effect = shown.unflatten(1, (CELLS, CHANNELS)), effect.unflatten(1, (CELLS, CHANNELS))
    assert (shown - effect)[:, 0].square().mean() < 0.03 * effect[:, 0].square().mean()
    plain = torch.linalg.lstsq(design, c).solution.unflatten(1, (CELLS, CHANNELS))
    assert shown[:, 2].square().sum() < 0.2 * plain[:, 2].square().sum()


@pytest.mark.parametrize("count", [12, 40, 400])
def test_effect_and_what_is_left_have_the_variance_of_the_people(count):
    ratios = []
    for seed in range(10):
        c, design, _ = people(count, seed)
        shown, away = regress_cells(c, design, INSIDE)
        left = (c - design @ away).square().sum() / count
        ratios.append(((left + shown.square().sum()) / (c.square().sum() / count)).item())
    assert sum(ratios) / len(ratios) == pytest.approx(1, abs=0.1)


def test_people_no_more_than_the_design_has_columns_show_nothing():
    c, design, _ = people(2, 0)
    shown, away = regress_cells(c, design, INSIDE)
    assert not shown.any()
    assert not away.any()
