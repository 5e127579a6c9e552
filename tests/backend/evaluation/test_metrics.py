"""Metrics of pictures, against scikit-image, torchmetrics and hand-made cases."""

import pytest
import torch
from primdiffusion.evaluation.metrics import (
    LARGEST_PSNR,
    Lpips,
    bounding_box,
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


def pictures(count=3, height=40, width=52, seed=0):
    """Smooth pictures and noisy copies."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(count, 3, 5, 6, generator=generator)
    target = nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0, 1).movedim(1, -1)
    amount = torch.linspace(0.02, 0.3, count)[:, None, None, None]
    image = (target + amount * torch.randn(target.shape, generator=generator)).clamp(0, 1)
    return image, target


def test_psnr_of_a_known_error():
    target = torch.full((2, 4, 4, 3), 0.5)
    image = target + torch.tensor([0.1, 0.01])[:, None, None, None]
    assert psnr(image, target).tolist() == pytest.approx([20, 40], abs=1e-3)


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


def test_ssim_is_one_of_equal_pictures_symmetric_and_falls_with_noise():
    image, target = pictures()
    assert ssim(target, target).tolist() == pytest.approx([1] * 3, abs=1e-5)
    assert torch.allclose(ssim(image, target), ssim(target, image), atol=1e-5)
    assert ssim(image, target).diff().max() < 0


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
