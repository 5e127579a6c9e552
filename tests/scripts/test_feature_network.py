"""The feature space of attributes: what is learned and stored, and detail in portraits, which blur takes away."""

import pytest
import torch
from primdiffusion.evaluation.metrics import frechet_distance
from primdiffusion.evaluation.pose_depth_network import BANDS, detail_energies
from torch.nn import functional

from scripts.feature_space.network import features_of
from scripts.feature_space.portraits import PORTRAITS
from scripts.train_attribute_network import (
    UNKNOWN,
    accuracies,
    fit_attribute_network,
    labels_of,
    visible_vocabulary,
)

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


def test_blurred_figures_are_far_from_sharp_ones_in_feature_space():
    sharp, others = noisy_figures(24), noisy_figures(24, seed=1)
    attributes = [{"sex": "female" if number % 2 else "male"} for number in range(24)]
    network = fit_attribute_network(sharp, attributes, epochs=1)
    real, same, soft = (features_of(network, pictures) for pictures in (sharp, others, blurred(others)))
    assert frechet_distance(soft, real) > 5 * frechet_distance(same, real)


def test_values_that_no_training_person_has_are_unknown():
    known = visible_vocabulary([{"sex": "male", "height": 1.6}, {"sex": "female", "height": 1.8}])
    labels = labels_of(known, [{"sex": "other", "height": 1.9}, {"sex": "female"}])
    assert labels["sex"].tolist() == [UNKNOWN, known.categories["sex"].index("female")]
    assert float(labels["height"][0]) == pytest.approx(2.0, rel=1e-5)
    assert labels["height"][1].isnan()


def painted(count: int, seed: int) -> tuple[torch.Tensor, list[dict[str, object]]]:
    """Pictures that are red or blue, as bright as the person is tall."""
    generator = torch.Generator().manual_seed(seed)
    sex, height = torch.randint(2, (count,), generator=generator), 1.5 + 0.5 * torch.rand(count, generator=generator)
    pictures = torch.zeros(count, 4, 32, 32, 4, dtype=torch.uint8)
    for number in range(count):
        pictures[number, :, 8:24, 8:24, 2 * int(sex[number])] = round(255 * (float(height[number]) - 1.3))
    people = [{"sex": "fm"[int(s)], "height": float(h)} for s, h in zip(sex, height, strict=True)]
    return pictures, people


@pytest.fixture(scope="module")
def trained():
    pictures, people = painted(64, 0)
    return fit_attribute_network(pictures, people, epochs=20, batch=16)


def test_network_learns_what_can_be_seen(trained):
    pictures, people = painted(32, 1)
    right = accuracies(trained, features_of(trained, pictures), people)
    assert right["sex"] == 1.0
    assert right["height"] > 0.5
