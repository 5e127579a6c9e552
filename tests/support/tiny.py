"""Models small enough to make in a test, and humans of noise.

`tiny_model` is a person prior without networks and a codec of four numbers a primitive; `slab_model` the paper's kind;
`tiny_encoder` has few channels, is untrained, and shows what it looked up in the pictures.
"""

import dataclasses
from pathlib import Path

import torch
from primdiffusion.diffusion.checkpoint import save_checkpoint
from primdiffusion.diffusion.codec import SCALE_VALUE, CellCodec, LinearCodec, WholeSlab
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.denoiser import LocalUNetConfig, PersonDenoiser
from primdiffusion.diffusion.model import STANDARD_SHAPES, DiffusionModel
from primdiffusion.diffusion.schedule import SCHEDULES, linear
from primdiffusion.diffusion.unet import SlabUNet, UNetConfig
from primdiffusion.encoder.config import EncoderConfig
from primdiffusion.encoder.model import EncoderModel, save_encoder
from primdiffusion.encoder.network import Encoder
from primdiffusion.human import Human
from primdiffusion.primitives.primitives import GRID, K, Payload, S
from support.priors import of_whole_body

FULL_DENSITY = 100.0
CHANNELS = 4
COMPONENTS = 3
VOCABULARY = AttributeVocabulary({"outfit": ("jeans", "suit")}, {"height": (1.75, 0.1), "weight": (66.0, 8.0)})


SLOW = LocalUNetConfig(widths=(128,))
"""Untrained, it adds nothing to what the prior says, in some 15 ms a step."""


def tiny_model(local: LocalUNetConfig | None = None) -> DiffusionModel:
    """Grey people, solid below the skin, whose garment colours (red, green, blue as a whole) vary."""
    voxels = torch.full((4, S, S, S), 0.5)
    voxels[3] = torch.linspace(1.0, 0.0, S)[:, None, None]
    basis = torch.zeros(CHANNELS, 4, S**3)
    basis[torch.arange(CHANNELS), torch.arange(CHANNELS)] = S**-1.5
    values = torch.cat([voxels.flatten(), torch.full((3,), SCALE_VALUE)])
    basis = torch.nn.functional.pad(basis.flatten(1), (0, 3))
    codec = LinearCodec(
        values.expand(K, -1).contiguous(), basis[None], torch.ones(1, CHANNELS), torch.zeros(K, dtype=torch.int64)
    )
    person = torch.zeros(COMPONENTS, CHANNELS, GRID * GRID)
    person[torch.arange(COMPONENTS), torch.arange(COMPONENTS)] = 1 / GRID
    prior = of_whole_body(
        mean=torch.zeros(CHANNELS, GRID, GRID),
        basis=person.flatten(1),
        parity=torch.ones(COMPONENTS),
        rest_variance=torch.full((CHANNELS, GRID, GRID), 0.01),
        log_weight=torch.tensor([[0.5, 0.5]]).log(),
        centre=torch.tensor([-1.0, 1.0])[None, :, None].repeat(1, 1, COMPONENTS),
        axes=torch.eye(COMPONENTS)[None],
        variance=torch.full((1, COMPONENTS), (1.2 * GRID) ** 2),
        kind=torch.nn.functional.pad(torch.eye(2), (0, VOCABULARY.width - 2))[None],
    )
    schedule = SCHEDULES["linear"]()
    denoiser = PersonDenoiser(local, prior, schedule)
    card = {"name": "tiny", "full_density": FULL_DENSITY}
    return DiffusionModel(denoiser, schedule, CellCodec(codec), STANDARD_SHAPES, FULL_DENSITY, card, VOCABULARY)


def model_of_two_kinds() -> DiffusionModel:
    """Women in jeans and men in suits, far from each other."""
    tiny = tiny_model()
    assert isinstance(tiny.denoiser, PersonDenoiser)
    prior = dataclasses.replace(
        tiny.denoiser.prior,
        centre=torch.tensor([-100.0, 100.0])[None, :, None].repeat(1, 1, COMPONENTS),
        variance=torch.ones(1, COMPONENTS),
        kind=torch.tensor([[[1.0, 0, 1, 0], [0, 1, 0, 1]]]),
    )
    denoiser = PersonDenoiser(None, prior, tiny.schedule)
    vocabulary = AttributeVocabulary({"sex": ("female", "male"), "outfit": ("jeans", "suit")}, {})
    return dataclasses.replace(tiny, denoiser=denoiser, vocabulary=vocabulary)


def save_tiny_checkpoint(path: Path, local: LocalUNetConfig | None = None) -> Path:
    """Writes `tiny_model` as a checkpoint file."""
    save_checkpoint(path, tiny_model(local), "linear")
    return path


TINY = EncoderConfig(
    stem=(2, 2, 4), grid=(4, 4), motion=4, attention_width=4, attention_heads=1, fused=4, colour=(2, 2),
    density=(2, 2), finest=2, scale=(4,),
)  # fmt: skip


def tiny_encoder() -> EncoderModel:
    """The same in every test."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return EncoderModel(Encoder(TINY).eval().requires_grad_(False), {"name": "tiny encoder"})


def save_tiny_encoder(path: Path) -> Path:
    """Writes `tiny_encoder` as a checkpoint file."""
    save_encoder(path, tiny_encoder())
    return path


SMALLEST = UNetConfig(width=32, multipliers=(1,) * 5, blocks=1)


def random_human(seed: int) -> Human:
    """Noise for a payload, which no codec holds without loss; betas and delta scales other than the defaults."""
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
