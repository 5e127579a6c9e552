"""Small made-up people for tests of the diffusion room."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import torch
from primdiffusion.diffusion.codec import SCALE_VALUE, VALUES, CellCodec, LinearCodec
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.denoiser import LocalUNetConfig, PersonDenoiser
from primdiffusion.diffusion.gaussian import PersonPrior
from primdiffusion.diffusion.model import DiffusionModel, ShapePrior
from primdiffusion.diffusion.schedule import linear
from primdiffusion.primitives.primitives import GRID, K, S
from support.priors import of_whole_body

CHANNELS, COMPONENTS = 4, 6
VOCABULARY = AttributeVocabulary({"outfit": ("jeans", "suit")}, {})
SMALL = LocalUNetConfig(widths=(8, 8), position_channels=2, condition_width=8, heads=2)


def random_prior(
    shape: tuple[int, int, int], components: int, parts: int, seed: int, groups: int = 1, asked: int = 0
) -> PersonPrior:
    """A mixture over latents of any shape, with variances that fall along the components; parts in each group."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> torch.Tensor:
        return torch.randn(size, generator=generator, dtype=torch.float64)

    size = shape[0] * shape[1] * shape[2]
    return of_whole_body(
        mean=normal(*shape),
        basis=torch.linalg.qr(normal(size, components))[0].T.contiguous(),
        parity=torch.ones(components),
        rest_variance=0.02 + 0.05 * torch.rand(shape, generator=generator, dtype=torch.float64),
        log_weight=torch.rand(groups, parts, generator=generator, dtype=torch.float64)
        .flatten()
        .log_softmax(0)
        .view(groups, parts),
        centre=2 * normal(groups, parts, components),
        axes=torch.linalg.qr(normal(groups, components, components))[0],
        variance=(0.5 + torch.rand(groups, components, generator=generator, dtype=torch.float64))
        / (1 + torch.arange(components, dtype=torch.float64)),
        kind=torch.nn.functional.one_hot(torch.arange(groups * parts) % max(asked, 1), max(asked, 1))[:, :asked]
        .double()
        .view(groups, parts, asked),
    )


def prior_of_parts(seed: int, asked: int = 0) -> PersonPrior:
    """Latents [2, 2, 3] of three parts with two components each; the second and the third part are the head."""
    shape, groups, kinds, heads = (2, 2, 3), 2, 3, 2
    generator = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> torch.Tensor:
        return torch.randn(size, generator=generator, dtype=torch.float64)

    def uniform(*size: int) -> torch.Tensor:
        return torch.rand(size, generator=generator, dtype=torch.float64)

    part = torch.tensor([0, 1, 0, 2, 2, 2])
    counts = part.bincount().tolist()
    basis = [torch.linalg.qr(normal(count * shape[0], 2))[0].view(count, shape[0], 2) for count in counts]
    kind = torch.nn.functional.one_hot(torch.arange(groups * kinds) % max(asked, 1), max(asked, 1))[:, :asked].double()
    return PersonPrior(
        mean=normal(*shape),
        basis=torch.cat(basis).permute(2, 0, 1).contiguous(),
        part=part,
        parity=torch.ones(6),
        rest_variance=0.02 + 0.05 * uniform(*shape),
        log_weight=uniform(groups, kinds).flatten().log_softmax(0).view(groups, kinds),
        centre=2 * normal(groups, kinds, 6),
        axes=torch.linalg.qr(normal(groups, 2, 1))[0].mT,
        variance=0.5 + uniform(groups, 1),
        left=0.1 + 0.2 * uniform(groups),
        head=torch.arange(groups * kinds).view(groups, kinds) % heads,
        head_axes=torch.linalg.qr(normal(heads, 4, 3))[0].mT,
        head_variance=0.5 + uniform(heads, 3),
        head_left=0.1 + 0.2 * uniform(heads),
        shared=normal(groups, 2, 2),
        head_shared=normal(heads, 2, 4),
        kind=kind.view(groups, kinds, asked),
    )


def small_model(seed: int = 0, scale: float = 3.0) -> DiffusionModel:
    """A model of the default architecture with few channels; its network's output is made to differ from 0."""
    asked = VOCABULARY.width
    prior = random_prior((CHANNELS, GRID, GRID), COMPONENTS, 2, seed, asked=asked).to(dtype=torch.float32)
    prior = dataclasses.replace(prior, centre=prior.centre * scale, variance=prior.variance * scale**2)
    torch.manual_seed(seed)
    denoiser = PersonDenoiser(SMALL, prior, linear()).eval()
    torch.nn.init.normal_(denoiser.local.outer.weight, std=0.1)
    basis = torch.linalg.qr(torch.randn(VALUES, CHANNELS))[0].T.contiguous()
    basis[:, -3:] = 0.0
    basis = torch.linalg.qr(basis.T)[0].T.contiguous()
    mean = torch.full((K, VALUES), 0.5)
    mean[:, -3:] = SCALE_VALUE
    codec = LinearCodec(mean, basis[None], torch.ones(1, CHANNELS), torch.zeros(K, dtype=torch.int64))
    shapes = ShapePrior(torch.randn(10, 3), torch.zeros(10), torch.eye(10), torch.full((10,), 2.5))
    return DiffusionModel(
        denoiser.requires_grad_(False),
        linear(),
        CellCodec(codec),
        shapes,
        100.0,
        {"name": "small", "licence": "CC0-1.0"},
        VOCABULARY,
    )


def write_people(folder: Path, geometries: int, variants: int = 2, outfits: int = 2) -> None:
    """Files of people that differ in outfit, in one direction of shape and in the colours of two garments."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    ramp = np.linspace(0, 1, S)[:, None, None]
    row = np.arange(K) // GRID
    for number in range(geometries):
        outfit, tall = number % outfits, rng.normal()
        density = np.clip(0.5 + 0.1 * tall - ramp + 0.2 * outfit * (row[:, None, None, None] > 12), 0, 1)
        density = np.broadcast_to(density, (variants, K, S, S, S))
        upper = (row < 10 + 6 * outfit)[None, :, None]
        colour = np.where(upper, rng.uniform(size=(variants, 1, 3)), rng.uniform(size=(variants, 1, 3)))
        colour = np.broadcast_to(colour[:, :, None, None, None, :], (variants, K, S, S, S, 3))
        voxels = np.concatenate([colour, density[..., None]], -1) * 255
        np.savez(
            folder / f"person_{number:06d}.npz",
            voxels=voxels.astype(np.uint8),
            betas=np.array([tall, *np.zeros(9)]),
            attributes=np.array(json.dumps({"outfit": f"outfit{outfit}"})),
            full_density=np.array(100.0),
        )
