"""The paper's U-Net against a second one, written in float64 from the names of its tensors and SPEC 3 alone."""

import json
import math

import pytest
import torch
from diffusion_people import small_model
from primdiffusion.diffusion.checkpoint import load_checkpoint, save_checkpoint
from primdiffusion.diffusion.codec import WholeSlab
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.schedule import linear
from primdiffusion.diffusion.unet import UNetConfig
from primdiffusion.files.tensor_file import save
from primdiffusion.training.config import TrainingConfig, check_resumable, to_json
from released_files import random_network
from safetensors import safe_open
from support.errors import refused
from torch import Tensor
from torch.nn import functional

PLAIN = UNetConfig(slab_channels=3, width=32, multipliers=(1, 2), blocks=2, heads=4)
ATTENTIVE = UNetConfig(slab_channels=3, width=32, multipliers=(1, 2), blocks=1, attention_levels=(0, 1), heads=8)


class Twin:
    """Layers are recognised by the names of their tensors."""

    def __init__(self, tensors: dict[str, Tensor], heads: int, reads_input: bool = False):
        self.w = {name: value.double() for name, value in tensors.items()}
        self.heads, self.reads_input = heads, reads_input

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
        context = x.flatten(2).transpose(1, 2) if self.reads_input else tokens
        first = self.layer_norm(tokens, f"{block}.norm1")
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
        earlier = Twin(network.state_dict(), config.heads, reads_input=True)(x, t)
        assert (earlier - found).abs().max() > 1e-3 * scale


def without_the_entry(settings: str) -> str:
    """Settings as the first versions wrote them."""
    tree = json.loads(settings)
    del tree["unet"]["attention_context"]
    return json.dumps(tree)


def test_networks_of_the_first_versions_are_told_apart_and_compute_as_they_did(tmp_path):
    config = UNetConfig(width=32, multipliers=(1, 1), blocks=1, heads=2, attention_context="input")
    network = random_network(config)
    model = DiffusionModel(network, linear(), WholeSlab(), small_model().shapes, 25.5, {})
    save_checkpoint(tmp_path / "new.safetensors", model, "linear")
    with safe_open(tmp_path / "new.safetensors", "pt") as file:
        tensors, metadata = {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118
    architecture = json.loads(metadata["architecture"])
    del architecture["config"]["attention_context"]
    (tmp_path / "old.safetensors").write_bytes(save(tensors, {**metadata, "architecture": json.dumps(architecture)}))
    x, t = noisy(56)
    for name in ("new", "old"):
        loaded = load_checkpoint(tmp_path / f"{name}.safetensors").denoiser
        assert loaded.config == config
        with torch.no_grad():
            expected = Twin(loaded.state_dict(), 2, reads_input=True)(x, t)
            assert (loaded(x, t) - expected).abs().max() < 1e-5 * expected.abs().max()


def test_runs_of_the_first_versions_resume_with_their_own_attention(tmp_path):
    def settings(**changes: object) -> TrainingConfig:
        return TrainingConfig(data=tmp_path / "people", run=tmp_path / "run", preset="paper", **changes)

    old = without_the_entry(to_json(settings()))
    check_resumable(old, settings(unet=UNetConfig(attention_context="input")))
    with refused(ValueError, "unet.attention_context"):
        check_resumable(old, settings())
    usual = TrainingConfig(data=tmp_path / "people", run=tmp_path / "run")
    check_resumable(without_the_entry(to_json(usual)), usual)
