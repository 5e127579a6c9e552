"""Stage 1 of the released code a second time, in float64 from SPEC 2 alone, with the names of `released_files`."""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional


class Slabs(NamedTuple):
    """Output in the released code's units and axes."""

    colour: Tensor
    """[K, 3, 8, 8, 8], 0 ... 255; axes C, D, H, W."""
    density: Tensor
    """[K, 8, 8, 8], 0 ... 255."""
    delta_s: Tensor
    """[K, 3]: divides the box."""


class StageOneTwin:
    """Runs on tensors without the prefix, from a texture of 256 x 256 and theta."""

    def __init__(self, tensors: dict[str, Tensor]):
        self.w = {name: value.double() for name, value in tensors.items()}

    def weight(self, name: str, gain_axis: int) -> Tensor:
        direction, gain = self.w[f"{name}.weight"], self.w[f"{name}.g"].flatten()
        shape = [1, 1, 1, 1]
        shape[gain_axis] = -1
        return gain.view(shape) * direction / (direction**2).sum().sqrt()

    def bias(self, name: str) -> Tensor:
        bias = self.w[f"{name}.bias"]
        return bias if bias.ndim == 3 else bias[:, None, None]

    def conv(self, x: Tensor, name: str, stride: int = 1) -> Tensor:
        weight = self.weight(name, 0)
        return functional.conv2d(x, weight, stride=stride, padding=(weight.shape[-1] - 1) // 2) + self.bias(name)

    def up(self, x: Tensor, name: str) -> Tensor:
        return functional.conv_transpose2d(x, self.weight(name, 1), stride=2, padding=1) + self.bias(name)

    def block(self, x: Tensor, name: str) -> Tensor:
        return lrelu(self.conv(lrelu(self.conv(x, f"{name}.conv1")), f"{name}.conv2")) + self.conv(
            x, f"{name}.conv_resize"
        )

    def appearance(self, texture: Tensor) -> Tensor:
        x = texture / 255
        for n in range(3):
            x = lrelu(self.conv(x, f"embs_encoder.down.{n}", 2))
        levels = [x]
        for n in range(3, 8):
            levels.append(lrelu(self.conv(levels[-1], f"embs_encoder.down.{n}", 2)))
        y = levels[5]
        for n in range(4):
            y = lrelu(self.up(y, f"embs_encoder.up.{n}")) + levels[4 - n]
        y = lrelu(self.up(y, "embs_encoder.up.4"))
        return 0.1 * self.conv(torch.cat([y, x], 1), "embs_encoder.out")

    def linear(self, x: Tensor, name: str) -> Tensor:
        name = f"transformer.{name}"
        found = x @ self.w[f"{name}.weight"].flatten(1).T
        return found + self.w[f"{name}.bias"] if f"{name}.bias" in self.w else found

    def layer_norm(self, x: Tensor, name: str) -> Tensor:
        variance, mean = torch.var_mean(x, -1, correction=0, keepdim=True)
        name = f"transformer.{name}"
        return (x - mean) / (variance + 1e-5).sqrt() * self.w[f"{name}.weight"] + self.w[f"{name}.bias"]

    def group_norm(self, x: Tensor) -> Tensor:
        parts = x.reshape(len(x), 32, -1)
        variance, mean = torch.var_mean(parts, -1, correction=0, keepdim=True)
        normal = ((parts - mean) / (variance + 1e-6).sqrt()).reshape(x.shape)
        return (
            normal * self.w["transformer.norm.weight"][:, None, None] + self.w["transformer.norm.bias"][:, None, None]
        )

    def attention(self, x: Tensor, name: str) -> Tensor:
        q, k, v = (self.linear(x, f"{name}.to_{part}") for part in "qkv")
        heads = []
        for first in range(0, 256, 64):
            part = slice(first, first + 64)
            heads.append((q[..., part] @ k[..., part].mT / math.sqrt(64)).softmax(-1) @ v[..., part])
        return self.linear(torch.cat(heads, -1), f"{name}.to_out.0")

    def transformer(self, x: Tensor) -> Tensor:
        tokens = self.linear(self.group_norm(x).flatten(2).mT, "proj_in")
        for block in ("transformer_blocks.0", "transformer_blocks.1"):
            tokens = tokens + self.attention(self.layer_norm(tokens, f"{block}.norm1"), f"{block}.attn1")
            tokens = tokens + self.attention(self.layer_norm(tokens, f"{block}.norm2"), f"{block}.attn2")
            hidden = self.linear(self.layer_norm(tokens, f"{block}.norm3"), f"{block}.ff.net.0.proj")
            value, gate = hidden[..., :1024], hidden[..., 1024:]
            gelu = gate * 0.5 * (1 + torch.erf(gate / math.sqrt(2)))
            tokens = tokens + self.linear(value * gelu, f"{block}.ff.net.2")
        return x + self.linear(tokens, "proj_out").mT.reshape(x.shape)

    def slab(self, x: Tensor, name: str) -> Tensor:
        x = lrelu(self.up(lrelu(self.up(x, f"{name}.0")), f"{name}.1"))
        return (25 * self.up(x, f"{name}.2") + 100).relu().clamp(0, 255)

    def __call__(self, texture: Tensor, theta: Tensor) -> Slabs:
        """Slabs of a texture [3, 256, 256], 0 ... 255, and axis-angles theta [72]."""
        motion = self.block(theta.double()[3:72].reshape(1, 69, 1, 1).expand(1, 69, 32, 32), "local_pose_conv_block")
        appearance = self.appearance(texture.double()[None])
        joint = self.block(self.transformer(torch.cat([motion, appearance], 1)), "joint_conv_block")
        scale = joint
        for n in range(5):
            scale = self.conv(lrelu(scale) if n else scale, f"decoder_motion.{n}")
        return Slabs(
            primitives(self.slab(joint, "decoder_rgb"), 3),
            primitives(self.slab(joint, "decoder_alpha"), 1)[:, 0],
            torch.exp(0.01 * scale[0, 6:9]).reshape(3, 1024).T,
        )


def lrelu(x: Tensor) -> Tensor:
    return torch.where(x > 0, x, 0.2 * x)


def primitives(slab: Tensor, channels: int) -> Tensor:
    """[1, 8 C, 256, 256] as [K, C, D, H, W]."""
    parts = slab.view(8, channels, 32, 8, 32, 8)  # d c ny h nx w
    return torch.einsum("dcyhxw->yxcdhw", parts).reshape(1024, channels, 8, 8, 8)
