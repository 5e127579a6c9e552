"""Give a checkpoint of the default preset a closed form fitted to other people; its codec and local network stay.

    python -m scripts.renew_closed_form --people people --more earlier_people --out start.safetensors
    primdiffusion train --start-from start.safetensors --data people --run runs/next

People whom training with the same `--holdout` and `--seed` holds out are left out. Plain colourings of `--more` count
for what people of a kind are like, not for how frequent the kind is. The network keeps its weights for what has not
changed. With `--surfaces-only` everything stays but the surfaces of clothes that these people wear, and which colours
surfaces have.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from primdiffusion.diffusion.checkpoint import load_checkpoint, save_checkpoint
from primdiffusion.diffusion.codec import CellCodec
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.gaussian import PersonPrior
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.surfaces import Surfaces
from primdiffusion.people.stored_people import PersonFolder
from primdiffusion.training.colour_pairs import with_colour_pairs
from primdiffusion.training.config import PriorConfig
from primdiffusion.training.latents import LatentSet, encode_people, split_people, vocabulary_of
from primdiffusion.training.prior import fit_prior, fit_shapes
from primdiffusion.training.surfaces import fit_surfaces
from torch import Tensor

OF_FACES = ("face", "features", "by_skin", "skin")
"""Fields of surfaces that do not depend on clothes."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--base", type=Path, help="checkpoint to renew; default: the included one")
    parser.add_argument("--people", type=Path, required=True, help="folder of `primdiffusion payloads`")
    parser.add_argument("--more", type=Path, help="further people, of an earlier wardrobe or of some outfits")
    parser.add_argument("--without", nargs="*", default=["suit"], help="outfits of --more that are left out")
    parser.add_argument(
        "--surfaces-only", action="store_true", help="find the surfaces of the people's outfits and keep all else"
    )
    parser.add_argument("--channels", type=int, default=96, help="leading latent channels of person components")
    parser.add_argument("--axes", type=int, default=64, help="principal axes of a covariance")
    parser.add_argument("--holdout", type=float, default=0.05, help="share of --people left out, as by training")
    parser.add_argument("--seed", type=int, default=0, help="seed of training, which says who is left out")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    base = load_checkpoint(arguments.base)
    assert isinstance(base.codec, CellCodec)
    codec, people = base.codec.codec, PersonFolder(arguments.people)
    vocabulary = base.vocabulary
    if not arguments.surfaces_only:
        vocabulary = vocabulary_of(known for index in range(len(people.names)) for known in people.known(index))
    fitted, _ = split_people(range(len(people.names)), arguments.holdout, arguments.seed)
    latents = encode_people(people, fitted, codec, vocabulary)
    if arguments.more is not None:
        more = PersonFolder(arguments.more)
        others = encode_people(more, range(len(more.names)), codec, vocabulary)
        used = [
            known.get("pattern") == "plain" and known.get("outfit") not in arguments.without
            for index in range(len(more.names))
            for known in more.known(index)
        ]
        latents = joined(latents, others, torch.tensor(used))
    config = PriorConfig(channels=arguments.channels, axes=arguments.axes)
    surfaces = fit_surfaces(latents, codec, vocabulary, config)
    generator = torch.Generator().manual_seed(arguments.seed)
    assert isinstance(base.denoiser, PersonDenoiser)
    if arguments.surfaces_only:
        if base.surfaces is not None and surfaces is not None:
            surfaces = with_clothes(base.surfaces, surfaces, outfits_of(latents, vocabulary, config))
        if surfaces is not None:
            surfaces = with_colour_pairs(surfaces, latents, codec, base.denoiser.prior, generator)
        save_checkpoint(arguments.out, dataclasses.replace(base, surfaces=surfaces), str(base.card["schedule"]))
        return
    prior = fit_prior(latents, codec, vocabulary, config)
    shapes = fit_shapes(latents, prior)
    if surfaces is not None:
        surfaces = with_colour_pairs(surfaces, latents, codec, prior, generator)
    denoiser = with_prior(base.denoiser, prior)
    card = {**base.card, "closed_form_geometries": len(latents.betas), "closed_form_people": len(latents)}
    model = DiffusionModel(
        denoiser, base.schedule, base.codec, shapes, base.full_density, card, vocabulary, base.chain, surfaces=surfaces
    )  # fmt: skip
    save_checkpoint(arguments.out, model, str(base.card["schedule"]))
    print(arguments.out, len(latents.betas), "geometries,", len(latents), "colourings")


def joined(latents: LatentSet, more: LatentSet, used: Tensor) -> LatentSet:
    """Add the samples of `more` that are used; detail is learned from the first set alone."""
    geometry, kept = more.geometry[used].unique(return_inverse=True)
    return LatentSet(
        torch.cat([latents.latents, more.latents[used]]),
        torch.cat([latents.geometry, kept + len(latents.betas)]),
        torch.cat([latents.betas, more.betas[geometry]]),
        torch.cat([latents.condition, more.condition[used]]),
        latents.detailed,
    )


def outfits_of(people: LatentSet, vocabulary: AttributeVocabulary, config: PriorConfig) -> Float[Tensor, "o a"]:
    """Conditions of the outfits that these people wear."""
    outfits = torch.stack(
        [vocabulary.encode({config.outfit: outfit}) for outfit in vocabulary.categories[config.outfit]]
    )
    return outfits[(people.condition @ outfits.T > 0).any(0)]


def with_clothes(base: Surfaces, renewed: Surfaces, outfits: Float[Tensor, "o a"]) -> Surfaces:
    """The surfaces of `base`, but those of these outfits, below hair, hats and shoes, from `renewed`; faces, which few
    people would make those of their outfits, only if `base` has none."""
    clothes = picked(renewed, (renewed.condition @ outfits.T > 0).any(1))
    others = picked(base, ~(base.condition @ outfits.T > 0).any(1))
    moved = dataclasses.replace(
        others,
        surface=others.surface + len(clothes.condition),
        garment=others.garment + len(clothes.condition),
        skirt=others.skirt + len(clothes.condition),
        printed=others.printed + len(clothes.garment),
        box=others.box + len(clothes.surface),
        paired=others.paired + len(clothes.condition),
    )
    names = [field.name for field in dataclasses.fields(Surfaces) if field.name not in OF_FACES]
    both = {name: torch.cat([getattr(clothes, name), getattr(moved, name)]) for name in names}
    faces = base if len(base.face) else renewed
    return Surfaces(**both, **{name: getattr(faces, name) for name in OF_FACES})


def picked(surfaces: Surfaces, which: Bool[Tensor, "l"]) -> Surfaces:
    """Some of the surfaces, with their boxes and prints."""
    rows, prints, skirts = which[surfaces.surface], which[surfaces.garment], which[surfaces.skirt]
    pairs = which[surfaces.paired]
    printed = prints[surfaces.printed]
    number, row, print_ = (mask.cumsum(0) - 1 for mask in (which, rows, prints))
    return dataclasses.replace(
        surfaces,
        condition=surfaces.condition[which],
        natural=surfaces.natural[which],
        surface=number[surfaces.surface[rows]],
        **{name: getattr(surfaces, name)[rows] for name in ("cell", "share", "tone", "read", "drawn")},
        garment=number[surfaces.garment[prints]],
        printed=print_[surfaces.printed[printed]],
        box=row[surfaces.box[printed]],
        second=surfaces.second[printed],
        skirt=number[surfaces.skirt[skirts]],
        **{name: getattr(surfaces, name)[skirts] for name in ("between", "dense", "size")},
        paired=number[surfaces.paired[pairs]],
        sampled=surfaces.sampled[pairs],
        worn=surfaces.worn[pairs],
    )


def with_prior(base: PersonDenoiser, prior: PersonPrior) -> PersonDenoiser:
    """A denoiser of another prior with the local network of `base`, which forgets attributes and person components."""
    denoiser = PersonDenoiser(base.config, prior, base.schedule)
    assert base.local is not None
    assert denoiser.local is not None
    weights = denoiser.local.state_dict()
    for name, weight in base.local.state_dict().items():
        if name in ("person.weight", "asked.weight"):
            weights[name] = torch.zeros_like(weights[name])
        elif name == "inner.weight":
            weights[name] = _inner_weight(base, denoiser)
        else:
            weights[name] = weight
    denoiser.local.load_state_dict(weights)
    return denoiser.eval().requires_grad_(False)


def _inner_weight(base: PersonDenoiser, denoiser: PersonDenoiser) -> Tensor:
    """Weights of the first convolution: those of the picture of person components, which it sees in units of its
    standard deviation, are rescaled, and those of channels that were not drawn are 0."""
    assert base.local is not None
    weight, channels = base.local.inner.weight, base.prior.mean.shape[0]
    rest, picture, position = weight.split(
        [channels, base.local.picture_channels, weight.shape[1] - channels - base.local.picture_channels], dim=1
    )
    drawn = denoiser.prior.basis.shape[2]
    both = min(drawn, picture.shape[1])
    ours = weight.new_zeros(len(weight), drawn, *weight.shape[2:])
    scale = denoiser.picture_std[:both] / base.picture_std[:both]
    ours[:, :both] = picture[:, :both] * scale[None, :, None, None]
    return torch.cat([rest, ours, position], dim=1)


if __name__ == "__main__":
    main()
