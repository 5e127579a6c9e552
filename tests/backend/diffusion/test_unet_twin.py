"""The paper's U-Net against a second one, written in float64 from the names of its tensors and SPEC 3 alone."""

import math

import pytest
import torch
from primdiffusion.diffusion.unet import UNetConfig
from released_files import random_network
from torch import Tensor
from torch.nn import functional

PLAIN = UNetConfig(slab_channels=3, width=32, multipliers=(1, 2), blocks=2, heads=4)
ATTENTIVE = UNetConfig(slab_channels=3, width=32, multipliers=(1, 2), blocks=1, attention_levels=(0, 1), heads=8)


class Twin:
    """Layers are recognised by the names of their tensors."""

    def __init__(self, tensors: dict[str, Tensor], heads: int):
        self.w = {name: value.double() for name, value in tensors.items()}
        self.heads = heads

    def linear(self, x: Tensor, name: str) -> Tensor:
        found = x @ self.w[f"{name}.weight"].T
        return found + self.w[f"{name}.bias"] if f"{name}.bias" in self.w else found

    def conv(self, x: Tensor, name: str, stride: int = 1) -> Tensor:
        weight = self.w[f"{name}.weight"]
        return functional.conv2d(x, weight, self.w[f"{name}.bias"], stride, padding=weight.shape[-1] // 2)

    def group_norm(self, x: Tensor, name: str, eps: float) -> Tensor:
        parts = x.reshape(len(x), 32, -1)
        variance, mean = torch.var_mean(parts, -1, correction=0, keepdim=True)
        normal = ((parts - mean) / (variance + eps).sqrt()).reshape(x.shape)
        return normal * self.w[f"{name}.weight"][:, None, None] + self.w[f"{name}.bias"][:, None, None]

    def layer_norm(self, x: Tensor, name: str) -> Tensor:
        variance, mean = torch.var_mean(x, -1, correction=0, keepdim=True)
        return (x - mean) / (variance + 1e-5).sqrt() * self.w[f"{name}.weight"] + self.w[f"{name}.bias"]

    def residual(self, x: Tensor, time: Tensor, name: str) -> Tensor:
        h = self.conv(silu(self.group_norm(x, f"{name}.in_layers.0", 1e-5)), f"{name}.in_layers.2")
        h = h + self.linear(silu(time), f"{name}.emb_layers.1")[:, :, None, None]
        h = self.conv(silu(self.group_norm(h, f"{name}.out_layers.0", 1e-5)), f"{name}.out_layers.3")
        skip = f"{name}.skip_connection"
        return h + (self.conv(x, skip) if f"{skip}.weight" in self.w else x)

    def attention(self, x: Tensor, context: Tensor, name: str) -> Tensor:
        q, k, v = (
            self.linear(x, f"{name}.to_q"),
            self.linear(context, f"{name}.to_k"),
            self.linear(context, f"{name}.to_v"),
        )
        width = q.shape[-1] // self.heads
        heads = []
        for first in range(0, q.shape[-1], width):
            part = slice(first, first + width)
            scores = q[..., part] @ k[..., part].transpose(1, 2) / math.sqrt(width)
            heads.append(scores.softmax(-1) @ v[..., part])
        return self.linear(torch.cat(heads, -1), f"{name}.to_out.0")

    def transformer(self, x: Tensor, name: str) -> Tensor:
        tokens = self.conv(self.group_norm(x, f"{name}.norm", 1e-6), f"{name}.proj_in").flatten(2).transpose(1, 2)
        block = f"{name}.transformer_blocks.0"
        context, first = tokens, self.layer_norm(tokens, f"{block}.norm1")
        tokens = tokens + self.attention(first, first, f"{block}.attn1")
        tokens = tokens + self.attention(self.layer_norm(tokens, f"{block}.norm2"), context, f"{block}.attn2")
        value, gate = self.linear(self.layer_norm(tokens, f"{block}.norm3"), f"{block}.ff.net.0.proj").chunk(2, -1)
        gelu = gate * 0.5 * (1 + torch.erf(gate / math.sqrt(2)))
        tokens = tokens + self.linear(value * gelu, f"{block}.ff.net.2")
        return x + self.conv(tokens.transpose(1, 2).reshape(x.shape), f"{name}.proj_out")

    def stage(self, x: Tensor, time: Tensor, name: str) -> Tensor:
        number = 0
        while any(key.startswith(f"{name}.{number}.") for key in self.w):
            layer = f"{name}.{number}"
            if f"{layer}.in_layers.0.weight" in self.w:
                x = self.residual(x, time, layer)
            elif f"{layer}.norm.weight" in self.w:
                x = self.transformer(x, layer)
            elif f"{layer}.op.weight" in self.w:
                x = self.conv(x, f"{layer}.op", stride=2)
            elif f"{layer}.conv.weight" in self.w:
                x = self.conv(x.repeat_interleave(2, 2).repeat_interleave(2, 3), f"{layer}.conv")
            else:
                x = self.conv(x, layer)
            number += 1
        return x

    def __call__(self, x: Tensor, t: Tensor) -> Tensor:
        half = self.w["time_embed.0.weight"].shape[1] // 2
        angle = t.double()[:, None] * torch.exp(-math.log(10_000) * torch.arange(half).double() / half)
        time = self.linear(torch.cat([angle.cos(), angle.sin()], -1), "time_embed.0")
        time, x = self.linear(silu(time), "time_embed.2"), x.double()
        skips, number = [], 0
        while any(key.startswith(f"input_blocks.{number}.") for key in self.w):
            x = self.stage(x, time, f"input_blocks.{number}")
            skips.append(x)
            number += 1
        x = self.stage(x, time, "middle_block")
        for number in range(len(skips)):
            x = self.stage(torch.cat([x, skips.pop()], 1), time, f"output_blocks.{number}")
        return self.conv(silu(self.group_norm(x, "out.0", 1e-5)), "out.2")


def silu(x: Tensor) -> Tensor:
    return x / (1 + (-x).exp())


def noisy(channels: int = 3) -> tuple[Tensor, Tensor]:
    return torch.randn(2, channels, 16, 16, generator=torch.Generator().manual_seed(1)), torch.tensor([3, 700])


def unet_error(config: UNetConfig) -> float:
    """Largest difference between the network and the twin, relative to the largest output."""
    network = random_network(config)
    x, t = noisy()
    with torch.no_grad():
        found = Twin(network.state_dict(), config.heads)(x, t)
        return float((network(x, t) - found).abs().max() / found.abs().max())


def attention_error(config: UNetConfig = ATTENTIVE) -> float:
    """As `unet_error`, of the transformer in the middle alone."""
    network, channels = random_network(config), config.width * config.multipliers[-1]
    x = torch.randn(2, channels, 16, 16, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        found = Twin(network.state_dict(), config.heads).transformer(x.double(), "middle_block.1")
        return float((network.middle_block[1](x) - found).abs().max() / found.abs().max())


def test_attention_alone_computes_what_the_reference_says():
    assert attention_error() < 1e-5


@pytest.mark.parametrize("config", [PLAIN, ATTENTIVE], ids=["plain", "attention"])
def test_the_network_computes_what_its_names_and_the_reference_say(config):
    assert unet_error(config) < 1e-5
    network = random_network(config)
    x, t = noisy()
    with torch.no_grad():
        found = Twin(network.state_dict(), config.heads)(x, t)
        scale = found.abs().max()
        network.double()
        assert (network(x.double(), t) - found).abs().max() < 1e-6 * scale  # features of t are in float32
