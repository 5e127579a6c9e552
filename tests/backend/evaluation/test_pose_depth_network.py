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
    joint_positions,
    load_pose_depth_network,
)
from primdiffusion.people.assets import open_assets

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
        fit_pose_depth_network(images, epochs=2, batch=8, report=lambda _, loss: losses.append(loss)) for _ in range(2)
    ]
    assert losses[:2] == losses[2:]
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
    errors = held_out_errors(network, training_images(assets, [3_100_000, 3_100_001], 16), PCK_SHARE)
    assert errors["pckh"] > stated["pckh"] - 20
    assert errors["depth"] < 2 * stated["depth"]
