"""Metrics of pictures, against scikit-image, torchmetrics and hand-made cases."""

import itertools

import numpy as np
import pytest
import scipy.linalg
import torch
from primdiffusion.evaluation.metrics import (
    LARGEST_PSNR,
    Lpips,
    bounding_box,
    frechet_distance,
    kernel_distance,
    load_lpips,
    overlap,
    psnr,
    ssim,
)
from primdiffusion.evaluation.pretrained_networks import ALEXNET, VGG16, PictureFeatures
from primdiffusion.files.regular_files import FileError
from safetensors.torch import save_file
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from support.errors import refused
from torch import nn
from torchmetrics.functional.image import lpips as torchmetrics_lpips
from torchmetrics.image.kid import poly_mmd

from scripts.feature_space.comparison import frechet_uncertainty, nearest, nearest_other, precision_recall


def pictures(count=3, height=40, width=52, seed=0):
    """Smooth pictures and noisy copies."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(count, 3, 5, 6, generator=generator)
    target = nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1).movedim(1, -1)
    amount = torch.linspace(0.02, 0.3, count)[:, None, None, None]
    image = (target + amount * torch.randn(target.shape, generator=generator)).clamp(0, 1)
    return image, target


def test_psnr_of_equal_pictures_is_finite():
    image, _ = pictures()
    assert psnr(image, image).tolist() == [LARGEST_PSNR] * 3


def test_psnr_is_that_of_scikit_image():
    image, target = pictures()
    theirs = [peak_signal_noise_ratio(t.numpy(), i.numpy(), data_range=1) for i, t in zip(image, target, strict=True)]
    assert psnr(image, target).tolist() == pytest.approx(theirs, abs=1e-4)


def test_ssim_is_that_of_scikit_image():
    image, target = pictures()
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    theirs = [
        structural_similarity(i.double().numpy(), t.double().numpy(), channel_axis=-1, **options)
        for i, t in zip(image, target, strict=True)
    ]
    assert ssim(image.double(), target.double()).tolist() == pytest.approx(theirs, abs=1e-9)
    assert ssim(image, target).tolist() == pytest.approx(theirs, abs=1e-4)


def test_metrics_take_any_batch_and_none():
    image, target = pictures(4)
    for metric in (psnr, ssim):
        each = metric(image, target)
        assert torch.allclose(
            metric(image.unflatten(0, (2, 2)), target.unflatten(0, (2, 2))), each.unflatten(0, (2, 2))
        )
        assert torch.allclose(metric(image[0], target[0]), each[0])


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_pictures_of_two_shapes_are_rejected(metric):
    with refused(ValueError, "[..., H, W, 3]"):
        metric(torch.zeros(20, 20, 3), torch.zeros(20, 21, 3))
    with refused(ValueError, "[..., H, W, 3]"):
        metric(torch.zeros(3, 20, 20), torch.zeros(3, 20, 20))


def test_ssim_says_what_it_needs_of_small_pictures():
    with refused(ValueError, "10 x 20 pixels"):
        ssim(torch.zeros(20, 10, 3), torch.zeros(20, 10, 3))


def test_overlap_is_intersection_over_union():
    first, second = torch.zeros(2, 4, 4, dtype=torch.bool)
    first[:2], second[1:3] = True, True
    assert overlap(first, second) == pytest.approx(4 / 12)
    assert overlap(first, first) == 1
    assert overlap(first & ~first, second & ~second) == 1


def test_bounding_box_holds_the_mask_and_a_window():
    mask = torch.zeros(30, 40, dtype=torch.bool)
    assert bounding_box(mask) is None
    mask[5:25, 10:22] = True
    assert bounding_box(mask) == (10, 5, 22, 25)
    corner = torch.zeros(30, 40, dtype=torch.bool)
    corner[29, 39] = True
    box = bounding_box(corner)
    assert box == (29, 19, 40, 30)
    image = torch.rand(30, 40, 3)
    assert torch.equal(box.cut(image), image[19:30, 29:40])
    assert ssim(box.cut(image), box.cut(image)) == pytest.approx(1)


def theirs_with_random_weights(net, architecture, monkeypatch, tmp_path):
    """torchmetrics' LPIPS on a network of ours (torchvision, which it asks for one, is not needed), and its file."""
    torch.manual_seed(1)
    layers = PictureFeatures(architecture, ["relu5_3" if architecture is VGG16 else "relu3_3"]).features
    monkeypatch.setattr(torchmetrics_lpips, "_get_tv_model_features", lambda *_, **__: layers)
    network = torchmetrics_lpips._LPIPS(pretrained=False, net=net)
    for linear in network.lins:
        linear.model[1].weight.data.uniform_(0, 1)
    torch.save(network.state_dict(), tmp_path / "whole.pth")
    return network, layers, tmp_path / "whole.pth"


@pytest.mark.parametrize(("net", "architecture"), [("alex", ALEXNET), ("vgg", VGG16)])
def test_lpips_is_that_of_torchmetrics_from_its_file(net, architecture, monkeypatch, tmp_path):
    theirs, _, path = theirs_with_random_weights(net, architecture, monkeypatch, tmp_path)
    image, target = pictures(2, 48, 64)
    ours = load_lpips([path])(image, target)
    wanted = theirs(image.movedim(-1, 1), target.movedim(-1, 1), normalize=True).flatten()
    assert ours.shape == (2,)
    assert ours.tolist() == pytest.approx(wanted.tolist(), rel=1e-3)
    assert ours[0] < ours[1]


def test_lpips_reads_a_network_and_the_linear_weights_that_torchmetrics_brings(tmp_path):
    network = PictureFeatures(ALEXNET, ["relu3_3"])
    save_file(network.state_dict() | {"classifier.1.weight": torch.zeros(2, 2)}, tmp_path / "alexnet.safetensors")
    linear = torchmetrics_lpips.__file__.removesuffix("lpips.py") + "lpips_models/alex.pth"
    lpips = load_lpips([tmp_path / "alexnet.safetensors", linear])
    image, target = pictures(2, 40, 40)
    assert lpips(image, image).tolist() == [0, 0]
    assert (lpips(image, target) > 0).all()
    assert lpips.linear[4].weight.shape == (1, 256, 1, 1)


def test_gradients_of_lpips_are_finite_also_in_black():
    image = torch.zeros(40, 40, 3, requires_grad=True)
    Lpips(ALEXNET)(image, torch.rand(40, 40, 3)).backward()
    assert torch.isfinite(image.grad).all()
    assert image.grad.abs().max() > 0


def test_files_of_another_network_are_rejected(tmp_path):
    torch.save(PictureFeatures(VGG16, ["relu5_3"]).state_dict(), tmp_path / "vgg16.pth")
    alex = torchmetrics_lpips.__file__.removesuffix("lpips.py") + "lpips_models/alex.pth"
    with refused(FileError, "linear.0.weight"):
        load_lpips([tmp_path / "vgg16.pth"])
    with refused(FileError, "linear.1.weight", "(1, 192, 1, 1)", "(1, 128, 1, 1)"):
        load_lpips([tmp_path / "vgg16.pth", alex])
    with refused(FileError):
        load_lpips([alex])


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


@pytest.mark.parametrize("count", [50, 800])
def test_the_uncertainty_is_the_spread_of_distances_of_other_samples(count):
    held = draws(400, 5, 1000)
    others = np.std([frechet_distance(draws(count, 5, seed), held) for seed in range(24)])
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
