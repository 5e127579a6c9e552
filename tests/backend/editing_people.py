"""People and a slab model for tests of the editing room."""

import torch
from primdiffusion.diffusion.codec import WholeSlab
from primdiffusion.diffusion.model import STANDARD_SHAPES, DiffusionModel
from primdiffusion.diffusion.schedule import linear
from primdiffusion.diffusion.unet import SlabUNet, UNetConfig
from primdiffusion.human import Human
from primdiffusion.primitives.primitives import K, Payload, S

FULL_DENSITY = 100.0
SMALLEST = UNetConfig(width=32, multipliers=(1,) * 5, blocks=1)


def anybody(seed: int) -> Human:
    """Noise for a payload, which no codec holds without loss; betas and delta scales that are nobody's default."""
    generator = torch.Generator().manual_seed(seed)
    payload = Payload(
        torch.rand(K, 3, S, S, S, generator=generator),
        FULL_DENSITY * torch.rand(K, S, S, S, generator=generator),
        0.8 + 0.4 * torch.rand(K, 3, generator=generator),
    )
    return Human(payload, torch.randn(10, generator=generator), {"seed": seed, "full_density": FULL_DENSITY})


def slab_model() -> DiffusionModel:
    """The paper's kind of model, with few channels and weights that are not those of the start, which guess 0."""
    torch.manual_seed(0)
    denoiser = SlabUNet(SMALLEST).eval().requires_grad_(False)
    torch.nn.init.normal_(denoiser.out[2].weight, std=0.01)
    return DiffusionModel(denoiser, linear(), WholeSlab(), STANDARD_SHAPES, FULL_DENSITY, {"name": "slab"})
