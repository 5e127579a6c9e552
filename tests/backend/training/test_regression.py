"""Regressions by cells: what shows an effect, what happens to look like it, and what is left."""

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


def test_what_follows_the_design_is_gone_from_what_is_left_and_the_rest_stays():
    c, design, effect = people(400, 0)
    _, left = regress_cells(c, design, INSIDE)
    parts, truth = left.unflatten(1, (CELLS, CHANNELS)), c - design @ effect
    assert (design.T @ parts[:, 0] / 400).abs().max() < 0.05
    assert torch.allclose(left[:, :CHANNELS], truth[:, :CHANNELS], atol=0.5)
    assert left[:, 2 * CHANNELS :].var() == pytest.approx(1, abs=0.05)


def test_people_no_more_than_the_design_has_columns_show_nothing():
    c, design, _ = people(2, 0)
    shown, left = regress_cells(c, design, INSIDE)
    assert not shown.any()
    assert torch.equal(left, c)
