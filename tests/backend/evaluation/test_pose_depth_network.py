"""Our own network of joints and depth: how it reads heatmaps, its training, and the weights that ship."""

import importlib.resources

import pytest
import torch
from primdiffusion.evaluation.images import JOINTS
from primdiffusion.evaluation.pose_depth_network import (
    CELLS,
    INPUT,
    PCK_SHARE,
    cell_means,
    correct_joints,
    depth_error,
    joint_positions,
    load_pose_depth_network,
)
from primdiffusion.people.assets import open_assets
from support.errors import refused

from scripts.train_pose_depth_network import (
    SWAPPED,
    TrainingImages,
    augmented,
    fit_pose_depth_network,
    held_out_errors,
    inverted_depth_loss,
    joint_loss,
    save_pose_depth_network,
    training_images,
)


def dots(count: int) -> TrainingImages:
    """Pictures of dark squares around the first joint."""
    generator = torch.Generator().manual_seed(0)
    joints = 0.3 + 0.4 * torch.rand(count, 12, 2, generator=generator)
    pictures = torch.full((count, 3, INPUT, INPUT), 255, dtype=torch.uint8)
    inverted = torch.zeros(count, CELLS, CELLS)
    for number, (x, y) in enumerate((INPUT * joints[:, 0]).long().tolist()):
        pictures[number, :, y - 8 : y + 8, x - 8 : x + 8] = 40
        inverted[number, y // 4 - 2 : y // 4 + 2, x // 4 - 2 : x // 4 + 2] = 0.25 + 0.01 * torch.rand(4, 4)
    attributes = tuple({"sex": ("male", "female")[number % 2], "height": 1.6 + number / 100} for number in range(count))
    return TrainingImages(pictures, joints, torch.full((count,), 0.05), inverted, attributes)


def test_joints_are_read_between_cells():
    joints = torch.tensor([[[0.413, 0.7], [0.02, 0.98]]])
    cells = torch.arange(CELLS) + 0.5
    x, y = (-0.5 * (cells - CELLS * joints[..., axis, None]).square() for axis in (0, 1))
    heatmaps = y[..., :, None] + x[..., None, :]
    assert (joint_positions(heatmaps)[0, 0] - joints[0, 0]).abs().max() < 0.1 / CELLS
    assert (joint_positions(heatmaps)[0, 1] - joints[0, 1]).abs().max() < 0.5 / CELLS


def test_the_loss_of_joints_is_least_at_the_joints():
    joints = dots(2).joints
    cells = torch.arange(CELLS) + 0.5
    x, y = (-0.5 * ((cells - CELLS * joints[..., axis, None]) / 0.8).square() for axis in (0, 1))
    right = y[..., :, None] + x[..., None, :]
    assert joint_loss(right, joints) < joint_loss(right.roll(1, -1), joints)


def test_the_loss_of_depth_is_affine_invariant():
    inverted = dots(2).inverted
    assert inverted_depth_loss(3 * inverted - 1, inverted) < 1e-3
    assert inverted_depth_loss(-inverted, inverted) > 3.5


def test_cells_are_means_of_what_shows_the_human():
    mask = torch.zeros(64, 64, dtype=torch.bool)
    mask[:32] = True
    cells = cell_means(torch.where(mask, 0.5, 9.0), mask)
    assert (cells[:16] == 0.5).all()
    assert (cells[16:] == 0).all()


def test_mirrored_and_moved_pictures_keep_their_joints():
    images = dots(4)
    assert [JOINTS[number] for number in SWAPPED[:2]] == ["right_shoulder", "left_shoulder"]
    for seed in range(4):
        pictures, joints, inverted = augmented(images, torch.arange(4), torch.Generator().manual_seed(seed))
        for picture, own, depth in zip(pictures, joints, inverted, strict=True):
            row, column = (picture.mean(0) < 0.6).nonzero().float().mean(0)
            middle = torch.stack([column + 0.5, row + 0.5]) / INPUT
            nearest = min((middle - own[0]).norm(), (middle - own[1]).norm())
            assert nearest < 1.5 / CELLS
            cell = (depth > 0).nonzero().float().mean(0)
            assert ((cell.flip(0) + 0.5) / CELLS - middle).norm() < 1.5 / CELLS


def test_training_is_deterministic_and_survives_its_file(tmp_path):
    images = dots(8)
    losses = []
    networks = [
        fit_pose_depth_network(images, epochs=1, batch=8, report=lambda _, loss: losses.append(loss)) for _ in range(2)
    ]
    assert losses[0] == losses[1]
    first, second = (network.state_dict() for network in networks)
    assert all(torch.equal(first[name], second[name]) for name in first)
    networks[0].card["errors"] = {"pckh": 50.0}
    save_pose_depth_network(tmp_path / "own.safetensors", networks[0])
    loaded = load_pose_depth_network(tmp_path / "own.safetensors")
    assert loaded.card == {"errors": {"pckh": 50.0}}
    pictures = images.pictures.float() / 255
    expected, found = networks[0](pictures), loaded(pictures)
    assert torch.allclose(expected.heatmaps, found.heatmaps, atol=0.05)


def test_the_weights_that_ship_are_small_and_as_good_as_their_card_says():
    path = importlib.resources.files("primdiffusion.weights") / "pose_depth.safetensors"
    assert path.stat().st_size <= 2_000_000
    network = load_pose_depth_network()
    stated = network.card["errors"]
    try:
        assets = open_assets()
    except FileNotFoundError as error:
        pytest.skip(str(error))
    errors = held_out_errors(network, training_images(assets, [3_100_000], 16), PCK_SHARE)
    assert errors["pckh"] > stated["pckh"] - 20
    assert errors["depth"] < 2 * stated["depth"]


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
