"""The sets that benchmarks/diffusion.py compares: all in T pose, produced one by one."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import torch
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.model import DiffusionModel, seeded_generator
from primdiffusion.formats import requests
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.human import Human, generate_batch, place
from primdiffusion.people.assets import Assets
from primdiffusion.people.base_mesh import load_base_mesh
from primdiffusion.people.payloads import rest_frames
from primdiffusion.people.person import make_person
from primdiffusion.people.stored_people import read_payloads
from primdiffusion.people.wardrobe import attribute_labels
from primdiffusion.primitives.from_mesh import FULL_DENSITY, colour, surface_field
from primdiffusion.primitives.primitives import Payload, Primitives
from primdiffusion.render.march import march
from torch import Tensor
from voxel_baseline import VoxelModel, primitives_of, voxelise_payload

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts.feature_space.portraits import PORTRAITS, camera_of

TOGETHER = 8
"""Batch size of sampling."""


def generated(
    model: DiffusionModel, seeds: Sequence[int], guidance: float = requests.Conditioning.guidance
) -> Iterator[Human]:
    """Ours, with the default sampler and steps; at guidance 0 person components are denoised without attributes."""
    for first in range(0, len(seeds), TOGETHER):
        yield from generate_batch(model, seeds[first : first + TOGETHER], guidance=guidance)


def gaussian(model: DiffusionModel, seeds: Sequence[int]) -> Iterator[Human]:
    """Draws of the Gaussian with the mean and covariance of the training people, by the same codec and body shapes."""
    if not isinstance(model.denoiser, PersonDenoiser):
        raise TypeError("only the default architecture holds a Gaussian of its training people")
    prior = model.denoiser.prior.gaussian()
    for seed in seeds:
        x0 = prior.sample(1, seeded_generator(seed))
        yield Human(model.decode(x0[0]), model.betas(x0, [seed])[0], {"seed": seed}).to("cpu")


def asked(model: DiffusionModel, seeds: Sequence[int], attributes: Mapping[str, str]) -> Iterator[Human]:
    """Ours with these attributes, at the default guidance."""
    for first in range(0, len(seeds), TOGETHER):
        yield from generate_batch(model, seeds[first : first + TOGETHER], attributes=attributes)


def like(model: DiffusionModel, people: Sequence[Mapping[str, object]]) -> Iterator[Human]:
    """Ours, each with the attributes of one of these people: distances do not depend on which outfits seeds drew."""
    known = model.vocabulary.categories
    for seed, attributes in enumerate(people):
        words = attribute_labels(attributes)
        yield from asked(model, [seed], {key: word for key, word in words.items() if word in known.get(key, ())})


def from_meshes(assets: Assets, seeds: Sequence[int], model: DiffusionModel | None = None) -> Iterator[Primitives]:
    """Payloads of `from_mesh`, through their storage in bytes; of a model after its codec."""
    for seed in seeds:
        person = make_person(assets, load_base_mesh(), seed)
        frames = rest_frames(person.betas)
        payload = colour(surface_field(person.mesh, frames), person.mesh)
        if model is not None:  # at the density that it learned
            share = model.full_density / FULL_DENSITY
            payload = dataclasses.replace(payload, density=payload.density * share)
            payload = plain(model.decode(model.encode(payload)))
        yield Primitives.place(frames, payload)


def placed(people: Iterator[Human]) -> Iterator[Primitives]:
    return (place(human) for human in people)


def voxels(model: VoxelModel, seeds: Sequence[int]) -> Iterator[Primitives]:
    return (model.primitives(person.grid) for person in model.sample(seeds))


def decoded(model: DiffusionModel, paths: Sequence[Path], colourings: int | None = None) -> Iterator[Primitives]:
    """Stored humans after the codec alone: the best that a perfect denoiser could generate."""
    for path in paths:
        person = read_payloads(path)
        frames = rest_frames(person.betas.numpy())
        for number in range(len(person.voxels))[:colourings]:
            yield Primitives.place(frames, plain(model.decode(model.encode(person.payload(number)))))


def plain(payload: Payload) -> Payload:
    """A copy on the CPU that the marcher accepts."""
    return payload.to("cpu").map(lambda tensor: tensor.clone())


def stored(paths: Sequence[Path], colourings: int | None = None) -> Iterator[Primitives]:
    """Stored humans, in all colourings or the first ones."""
    for path in paths:
        person = read_payloads(path)
        frames = rest_frames(person.betas.numpy())
        for number in range(len(person.voxels))[:colourings]:
            yield Primitives.place(frames, person.payload(number))


def stored_voxels(
    paths: Sequence[Path], model: VoxelModel | None = None, colourings: int | None = None
) -> Iterator[Primitives]:
    """Stored humans as grids of 64^3 voxels, the limit of that representation; with a model, after its codec."""
    for path in paths:
        person = read_payloads(path)
        frames = rest_frames(person.betas.numpy())
        for number in range(len(person.voxels))[:colourings]:
            grid = voxelise_payload(frames, person.payload(number), person.full_density)
            shown = grid.float() / 255 if model is None else model.codec.decode(model.codec.encode(grid))
            yield primitives_of(shown, person.full_density)


def front(primitives: Primitives) -> Tensor:
    """An sRGB picture from the front over white, 299 x 299, as networks for photographs take it."""
    view = march(primitives, camera_of(PORTRAITS[0], 299))
    return encode_srgb(view.over((1.0, 1.0, 1.0)).clamp(0, 1))


def seeds_of(count: int, first: int = 0) -> list[int]:
    """Consecutive seeds, not hand-picked."""
    return torch.arange(first, first + count).tolist()
