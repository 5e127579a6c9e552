"""A new closed form for a checkpoint: what its local network keeps."""

import dataclasses

import torch
from diffusion_people import small_model
from primdiffusion.diffusion.surfaces import Surfaces, optional_fields
from primdiffusion.training.latents import LatentSet

from scripts.renew_closed_form import joined, picked, with_clothes, with_prior


def test_the_local_network_keeps_all_but_attributes_and_person_components():
    base = small_model().denoiser
    same = with_prior(base, base.prior)
    for name, weight in same.local.state_dict().items():
        wanted = base.local.state_dict()[name]
        assert torch.equal(weight, torch.zeros_like(wanted) if name in ("person.weight", "asked.weight") else wanted)


def test_weights_of_the_picture_of_components_follow_its_spread():
    base = small_model().denoiser
    wider = dataclasses.replace(base.prior, variance=4 * base.prior.variance, left=4 * base.prior.left,
                                head_variance=4 * base.prior.head_variance, head_left=4 * base.prior.head_left,
                                centre=2 * base.prior.centre, shared=2 * base.prior.shared,
                                head_shared=2 * base.prior.head_shared)  # fmt: skip
    same, twice = (with_prior(base, prior).local.inner.weight for prior in (base.prior, wider))
    channels, drawn = base.prior.mean.shape[0], base.prior.basis.shape[2]
    assert torch.allclose(twice[:, channels : channels + drawn], 2 * same[:, channels : channels + drawn], rtol=1e-4)
    assert torch.equal(twice[:, :channels], same[:, :channels])


def test_further_people_count_without_their_detail():
    def people(geometry):
        count = len(geometry)
        return LatentSet(torch.zeros(count, 1, 1, 1), torch.tensor(geometry), torch.arange(10.0).repeat(3, 1),
                         torch.zeros(count, 1), torch.tensor(count))  # fmt: skip

    both = joined(people([0, 0, 1, 2]), people([0, 1, 1, 2]), torch.tensor([False, True, True, True]))
    assert both.geometry.tolist() == [0, 0, 1, 2, 3, 3, 4]
    assert len(both.betas) == 5
    assert both.detailed == 4


def clothes(outfits, cells, printed):
    """One surface on one box for each row of `outfits`, and prints on surfaces."""
    count, prints = len(outfits), len(printed)
    flags = torch.ones(count, dtype=torch.bool)
    return Surfaces(
        outfits, flags, torch.arange(count), torch.tensor(cells), torch.rand(count, 512), torch.rand(count, 512),
        flags, flags, torch.tensor(printed), torch.arange(prints), torch.tensor(printed), torch.rand(prints, 512),
        **{**optional_fields(), "paired": torch.arange(count), "sampled": outfits, "worn": 1 - outfits},
    )  # fmt: skip


def test_clothes_of_some_outfits_are_renewed_with_their_prints():
    tee, suit, hair = torch.eye(3)
    base = clothes(torch.stack([tee, suit, hair]), [1, 2, 3], [0, 1])
    renewed = clothes(torch.stack([hair, tee, tee]), [4, 5, 6], [2, 1])
    both = with_clothes(base, renewed, tee[None])
    assert torch.equal(both.condition, torch.stack([tee, tee, suit, hair]))
    assert both.cell.tolist() == [5, 6, 2, 3]
    assert torch.equal(both.tone, torch.cat([renewed.tone[1:], base.tone[1:]]))
    assert both.surface.tolist() == [0, 1, 2, 3]
    assert both.garment.tolist() == both.box.tolist() == [1, 0, 2]
    assert both.paired.tolist() == [0, 1, 2, 3]
    assert torch.equal(both.sampled, both.condition)
    assert torch.equal(both.second[both.printed], torch.cat([renewed.second, base.second[1:]]))
    face = {"face": torch.arange(1), "features": torch.rand(1, 512, 3), "by_skin": torch.rand(1, 512)}
    of_tees = dataclasses.replace(renewed, **face)
    assert torch.equal(with_clothes(base, of_tees, tee[None]).features, of_tees.features)  # base has no faces
    of_all = dataclasses.replace(base, **{name: 0 * values for name, values in face.items()})
    assert torch.equal(with_clothes(of_all, of_tees, tee[None]).features, of_all.features)
    assert all(torch.equal(getattr(picked(base, base.natural), name), value) for name, value in vars(base).items())
