"""An encoder small enough to make in a test: few channels, untrained; it shows what it looked up in the pictures."""

from pathlib import Path

import torch
from primdiffusion.encoder.config import EncoderConfig
from primdiffusion.encoder.model import EncoderModel, save_encoder
from primdiffusion.encoder.network import Encoder

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
