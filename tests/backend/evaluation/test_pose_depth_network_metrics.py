"""PCKh and depth error: known shares of synthetic keypoints, affine depth, unrelated depth."""

import pytest
import torch
from primdiffusion.evaluation.pose_depth_network import correct_joints, depth_error
from support.errors import refused


def placed_joints() -> torch.Tensor:
    """Verdicts on 12 joints whose distance from the truth is just below half a head for 9, just above for 3."""
    true = torch.rand(12, 2, generator=torch.Generator().manual_seed(0)) * 500
    angle = torch.arange(12.0)
    away = torch.stack([angle.cos(), angle.sin()], -1)
    reach = torch.tensor([9.99] * 9 + [10.01] * 3)
    return correct_joints(true + reach[:, None] * away, true, head_size=20.0)


def pck_error() -> float:
    """Difference of PCKh from the share that is known by construction."""
    return abs(float(placed_joints().double().mean()) - 9 / 12)


def test_pckh_is_the_share_of_joints_within_half_a_head():
    right = placed_joints()
    assert right.double().mean() == 0.75
    assert right.tolist() == [True] * 9 + [False] * 3


def test_pckh_needs_a_head():
    with refused(ValueError, "head size"):
        correct_joints(torch.zeros(3, 2), torch.zeros(3, 2), 0.0)


@pytest.fixture
def surface() -> tuple[torch.Tensor, torch.Tensor]:
    row, column = torch.meshgrid(torch.linspace(-1, 1, 64), torch.linspace(-1, 1, 64), indexing="ij")
    mask = row.square() + column.square() < 0.8
    depth = torch.where(mask, 4 - 0.3 * (1 - row.square() - column.square()).clamp_min(0).sqrt(), torch.inf)
    return depth, mask


def test_affine_inverted_depth_has_no_error(surface):
    depth, mask = surface
    inverted = torch.where(mask, 70 / depth - 3, torch.nan)
    assert depth_error(inverted, depth, mask) < 1e-8


def test_depth_error_is_twice_the_missing_correlation(surface):
    depth, mask = surface
    noise = torch.randn(depth.shape, generator=torch.Generator().manual_seed(0))
    seen = 1 / depth + 0.01 * noise
    correlation = torch.corrcoef(torch.stack([seen[mask], 1 / depth[mask]]).double())[0, 1]
    assert depth_error(seen, depth, mask) == pytest.approx(2 * (1 - float(correlation)), rel=1e-6)
    assert depth_error(-1 / depth, depth, mask) == pytest.approx(4)


def test_flat_maps_and_background_are_no_measure(surface):
    depth, mask = surface
    assert depth_error(torch.ones_like(depth), depth, mask) == 2
    assert depth_error(1 / depth, torch.where(mask, 4.0, torch.inf), mask) is None
    assert depth_error(1 / depth, depth, torch.zeros_like(mask)) is None
