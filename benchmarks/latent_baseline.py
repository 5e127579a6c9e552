"""The paper's Table 2 baseline "latents": one vector for a whole human is diffused, and decoded to primitives once.

Everything is the default model's, trained alike: codec, person components and their network. The vector is the person's
components. But the U-Net over the grid is no denoiser: it decodes what the components leave out from the vector alone,
so that nothing about a human is drawn at random on the grid. A trained baseline is a checkpoint of the default
architecture, whose card says `baseline: latents`; only `sample_people` may sample it.

The paper's own latents are codes at the vertices of the body, decoded by sparse convolutions to a radiance field.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Float
from primdiffusion.diffusion.codec import LinearCodec
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.model import DiffusionModel, seeded_generator
from primdiffusion.diffusion.samplers import SAMPLERS
from primdiffusion.human import Human, decode_humans
from primdiffusion.training.config import NetworkTraining
from primdiffusion.training.latents import LatentSet
from primdiffusion.training.losses import blends, mix, weighted_error
from torch import Tensor

STEPS = 30


def decoded_rest(denoiser: PersonDenoiser, coefficients: Float[Tensor, "b r"]) -> Float[Tensor, "b c h w"]:
    """What the components leave out, decoded from them, in its standard deviations."""
    if denoiser.local is None:
        raise ValueError("this denoiser has no network over the grid, which is the decoder: give it a size")
    prior = denoiser.prior
    picture = prior.picture(coefficients) / denoiser.picture_std[:, None, None]
    t = torch.zeros(len(coefficients), dtype=torch.int64)
    with torch.autocast("cpu", denoiser.network_dtype, enabled=denoiser.network_dtype != torch.float32):
        rest = denoiser.local(torch.zeros_like(picture), picture, coefficients / denoiser.component_std, t)
    return rest.float()


@dataclasses.dataclass
class DecoderObjective:
    """Loss of the decoder: the rest of training people, mixed and mirrored as for our model."""

    denoiser: PersonDenoiser
    people: LatentSet
    codec: LinearCodec
    config: NetworkTraining

    def loss(self, generator: torch.Generator) -> Tensor:
        """Weighted error of a random batch."""
        weights, indices = blends(self.people, self.config.batch, self.config.blend, generator)
        z = mix(self.people.latents, weights, indices)
        flip = torch.rand(len(z), generator=generator) < 0.5
        z[flip] = self.codec.mirror(z[flip])
        coefficients, rest = self.denoiser.prior.split(z)
        std = self.denoiser.prior.rest_variance.sqrt()
        error = decoded_rest(self.denoiser, coefficients) - rest / std
        return weighted_error(error, std.expand(len(z), *std.shape))


def sample_people(model: DiffusionModel, seeds: Sequence[int], steps: int = STEPS) -> list[Human]:
    """A human for each seed: the vector by DDIM from the start that our model has, then decoded."""
    denoiser, schedule = model.denoiser, model.schedule
    if not isinstance(denoiser, PersonDenoiser) or model.card.get("baseline") != "latents":
        raise ValueError("this is no latent baseline: train one with benchmarks/train_baselines.py")
    prior, chain = denoiser.prior, model.chain(schedule.length, steps)
    starts = []
    for seed in seeds:
        generator = seeded_generator(seed)
        clean, _ = prior.split(prior.sample(1, generator))
        noise = torch.randn(clean.shape, generator=generator)
        starts.append(schedule.signal(chain[0]) * clean + schedule.noise(chain[0]) * noise)

    def denoise(y: Tensor, t: int) -> Tensor:
        return denoiser.coefficients(y, torch.full((len(y),), t))

    with torch.inference_mode():
        *_, last = SAMPLERS["ddim"](denoise, schedule, torch.cat(starts), chain, seeded_generator(0))
        x0 = prior.join(last.x0, prior.rest_variance.sqrt() * decoded_rest(denoiser, last.x0)).clone()
        return [human.validate() for human in decode_humans(model, x0, seeds)]
