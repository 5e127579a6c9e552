"""Detail in portraits: what blur takes away, and what it does not depend on."""

import pytest
import torch
from primdiffusion.evaluation.attribute_network import BANDS, detail_energies, features_of, fit_attribute_network
from primdiffusion.evaluation.distances import frechet_distance
from primdiffusion.evaluation.gallery import PORTRAITS
from torch.nn import functional

SIDE = 96


def noisy_figures(count, seed=0):
    """Portraits of a noisy square on nothing, as bytes."""
    generator = torch.Generator().manual_seed(seed)
    rgba = torch.zeros(count, len(PORTRAITS), SIDE, SIDE, 4)
    contrast = 0.1 + 0.2 * torch.rand(count, 1, 1, 1, 1, generator=generator)
    noise = torch.rand(count, len(PORTRAITS), 64, 64, 1, generator=generator) - 0.5
    rgba[:, :, 16:-16, 16:-16, :3] = 0.5 + contrast * noise
    rgba[:, :, 16:-16, 16:-16, 3] = 1
    return (rgba * 255).round().to(torch.uint8)


def blurred(pictures):
    """Every colour averaged with its neighbours; the figure's outline stays."""
    planes = pictures[..., :3].float().movedim(-1, -3).flatten(0, 2)[:, None]
    inside = pictures[..., 3:].float().movedim(-1, -3).repeat_interleave(3, 2).flatten(0, 2)[:, None] / 255
    mean = functional.avg_pool2d(planes, 3, 1, 1) / functional.avg_pool2d(inside, 3, 1, 1).clamp_min(1e-6) * inside
    result = pictures.clone()
    result[..., :3] = mean.reshape(*pictures.shape[:2], 3, SIDE, SIDE).movedim(-3, -1).round().to(torch.uint8)
    return result


def test_blur_lowers_the_energy_of_fine_detail_most():
    sharp = noisy_figures(4)
    lost = (detail_energies(sharp) - detail_energies(blurred(sharp))).reshape(4, len(PORTRAITS), len(BANDS))
    assert float(lost[..., 0].min()) > 2
    assert (lost[..., 0] > lost[..., 1]).all()
    assert (lost[..., 1] > lost[..., 2]).all()


def test_outlines_are_not_detail():
    plain = noisy_figures(1)
    plain[..., 16:-16, 16:-16, :3] = 200
    assert float(detail_energies(plain).exp().max()) == pytest.approx(1e-7, rel=0.1)


def test_blurred_figures_are_far_from_sharp_ones_in_feature_space():
    sharp, others = noisy_figures(24), noisy_figures(24, seed=1)
    attributes = [{"sex": "female" if number % 2 else "male"} for number in range(24)]
    network = fit_attribute_network(sharp, attributes, epochs=1)
    real, same, soft = (features_of(network, pictures) for pictures in (sharp, others, blurred(others)))
    assert frechet_distance(soft, real) > 5 * frechet_distance(same, real)
