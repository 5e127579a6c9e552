"""CLIP's ViT-B/32 (Radford et al. 2021), the feature extractor of FID_CLIP (Kynkäänniemi et al. 2022).

Weights come from a file under OpenAI's layer names; nothing is downloaded. OpenAI's own file is a TorchScript program
and is not run: save its state_dict() as .safetensors.
"""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from primdiffusion.picture_features import fill, read_weights

SIDE, PATCH, WIDTH, LAYERS, HEADS, FEATURES = 224, 32, 768, 12, 12, 512
MEAN, STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
PREFIX = "visual."
"""Prefix of these weights in files that also hold the text encoder."""


class QuickGelu(nn.Module):
    """x sigmoid(1.702 x)."""

    def forward(self, x: Tensor) -> Tensor:
        """Apply the activation elementwise."""
        return x * torch.sigmoid(1.702 * x)


class Block(nn.Module):
    """Pre-norm residual block: self-attention, then a perceptron."""

    def __init__(self) -> None:
        super().__init__()
        self.attn = nn.MultiheadAttention(WIDTH, HEADS, batch_first=True)
        self.ln_1, self.ln_2 = nn.LayerNorm(WIDTH), nn.LayerNorm(WIDTH)
        layers = (("c_fc", nn.Linear(WIDTH, 4 * WIDTH)), ("gelu", QuickGelu()), ("c_proj", nn.Linear(4 * WIDTH, WIDTH)))
        self.mlp = nn.Sequential(OrderedDict(layers))

    def forward(self, x: Float[Tensor, "n t c"]) -> Float[Tensor, "n t c"]:
        """The tokens after this block."""
        normalised = self.ln_1(x)
        x = x + self.attn(normalised, normalised, normalised, need_weights=False)[0]
        return x + self.mlp(self.ln_2(x))


class Transformer(nn.Module):
    """The stack of blocks."""

    def __init__(self) -> None:
        super().__init__()
        self.resblocks = nn.Sequential(*(Block() for _ in range(LAYERS)))


class ClipVision(nn.Module):
    """Image encoder with 512 features. Weights are random until `load_clip_vision` fills them."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, WIDTH, PATCH, PATCH, bias=False)
        self.class_embedding = nn.Parameter(torch.randn(WIDTH) / WIDTH**0.5)
        self.positional_embedding = nn.Parameter(torch.randn((SIDE // PATCH) ** 2 + 1, WIDTH) / WIDTH**0.5)
        self.ln_pre, self.ln_post, self.transformer = nn.LayerNorm(WIDTH), nn.LayerNorm(WIDTH), Transformer()
        self.proj = nn.Parameter(torch.randn(WIDTH, FEATURES) / WIDTH**0.5)
        self.requires_grad_(False).eval()

    def forward(self, pictures: Float[Tensor, "n h w 3"]) -> Float[Tensor, "n 512"]:
        """Features of sRGB-encoded square pictures in [0, 1]."""
        x = functional.interpolate(
            pictures.movedim(-1, 1), (SIDE, SIDE), mode="bicubic", align_corners=False, antialias=True
        )
        mean, std = (x.new_tensor(values)[:, None, None] for values in (MEAN, STD))
        patches = self.conv1((x.clamp(0, 1) - mean) / std).flatten(2).mT
        first = self.class_embedding.expand(len(x), 1, -1)
        tokens = self.ln_pre(torch.cat([first, patches], dim=1) + self.positional_embedding)
        return self.ln_post(self.transformer.resblocks(tokens)[:, 0]) @ self.proj


def load_clip_vision(path: Path | str) -> ClipVision:
    """Load the encoder from a weights file. Raises FileNotFoundError and WeightsFileError."""
    network = ClipVision()
    weights = {name.removeprefix(PREFIX): value.float() for name, value in read_weights(path).items()}
    fill(network, weights, "CLIP's ViT-B/32", str(path))
    return network
