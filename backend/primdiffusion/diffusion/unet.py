"""The paper's denoiser: a U-Net over the whole slab, with the parameter names of the ADM family (SPEC 3).

The names and shapes are those of the released checkpoints' `diffusion.*` keys, so such weights load unchanged.
956 GFLOP a call for one person: a network for GPUs. `denoiser` has the light one.
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from primdiffusion.diffusion.denoiser import TimeEmbedding, zero_weights


@dataclasses.dataclass(frozen=True)
class UNetConfig:
    """Size of the slab U-Net; the defaults are the `paper` preset, 84,846,776 parameters in 298 tensors."""

    slab_channels: int = 56
    """Channels of the slab, in and out."""
    width: int = 128
    """Channels at full resolution."""
    multipliers: tuple[int, ...] = (1, 2, 3, 4)
    """Channels of each level in units of `width`; the resolution halves from one to the next."""
    blocks: int = 2
    """Residual blocks of a level on the way down; one more on the way up."""
    attention_levels: tuple[int, ...] = ()
    """Levels with a transformer after each residual block. The released code has none (SPEC 1.3); (2, 3) is the variant
    its configuration meant, 129,996,856 parameters."""
    heads: int = 8
    """Attention heads of every transformer."""


PAPER = UNetConfig()
PAPER_WITH_ATTENTION = UNetConfig(attention_levels=(2, 3))


class ResidualBlock(nn.Module):
    """GroupNorm - SiLU - conv, plus time, GroupNorm - SiLU - conv, plus the input."""

    def __init__(self, channels: int, out_channels: int, time_width: int):
        super().__init__()
        self.in_layers = nn.Sequential(
            nn.GroupNorm(32, channels), nn.SiLU(), nn.Conv2d(channels, out_channels, 3, padding=1)
        )
        self.emb_layers = nn.Sequential(nn.SiLU(), nn.Linear(time_width, out_channels))
        self.out_layers = nn.Sequential(
            nn.GroupNorm(32, out_channels),
            nn.SiLU(),
            nn.Identity(),
            zero_weights(nn.Conv2d(out_channels, out_channels, 3, padding=1)),
        )
        same = channels == out_channels
        self.skip_connection = nn.Identity() if same else nn.Conv2d(channels, out_channels, 1)

    def forward(self, x: Float[Tensor, "b c h w"], time: Float[Tensor, "b e"]) -> Float[Tensor, "b d h w"]:
        """The block's output for an input and a time embedding."""
        h = self.in_layers(x) + self.emb_layers(time)[:, :, None, None]
        return self.skip_connection(x) + self.out_layers(h)


class CrossAttention(nn.Module):
    """Multi-head attention of queries on a context; without a bias on the projections in."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        self.heads = heads
        self.to_q = nn.Linear(channels, channels, bias=False)
        self.to_k = nn.Linear(channels, channels, bias=False)
        self.to_v = nn.Linear(channels, channels, bias=False)
        self.to_out = nn.Sequential(nn.Linear(channels, channels), nn.Identity())

    def forward(self, x: Float[Tensor, "b n c"], context: Float[Tensor, "b m c"]) -> Float[Tensor, "b n c"]:
        """Each query's mean of the context's values."""
        q, k, v = (
            part.unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for part in (self.to_q(x), self.to_k(context), self.to_v(context))
        )
        return self.to_out(functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(-2))


class GatedLinear(nn.Module):
    """GEGLU: a linear map gated by the GELU of another."""

    def __init__(self, channels: int, inner: int):
        super().__init__()
        self.proj = nn.Linear(channels, 2 * inner)

    def forward(self, x: Float[Tensor, "*b c"]) -> Float[Tensor, "*b inner"]:
        """The gated features."""
        value, gate = self.proj(x).chunk(2, dim=-1)
        return value * functional.gelu(gate)


class FeedForward(nn.Module):
    """GEGLU four times as wide, and back."""

    def __init__(self, channels: int):
        super().__init__()
        self.net = nn.Sequential(GatedLinear(channels, 4 * channels), nn.Identity(), nn.Linear(4 * channels, channels))

    def forward(self, x: Float[Tensor, "*b c"]) -> Float[Tensor, "*b c"]:
        """The transformed tokens."""
        return self.net(x)


class TransformerBlock(nn.Module):
    """Self-attention, attention on the block's own input, feed-forward, each normalised first and added (SPEC 3)."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        self.attn1, self.ff, self.attn2 = (
            CrossAttention(channels, heads),
            FeedForward(channels),
            CrossAttention(channels, heads),
        )
        self.norm1, self.norm2, self.norm3 = (nn.LayerNorm(channels) for _ in range(3))

    def forward(self, x: Float[Tensor, "b n c"]) -> Float[Tensor, "b n c"]:
        """The transformed tokens."""
        normalised, context = self.norm1(x), x
        x = x + self.attn1(normalised, normalised)
        x = x + self.attn2(self.norm2(x), context)
        return x + self.ff(self.norm3(x))


class SpatialTransformer(nn.Module):
    """One transformer block over the pixels (SPEC 3)."""

    def __init__(self, channels: int, config: UNetConfig):
        super().__init__()
        self.norm = nn.GroupNorm(32, channels, eps=1e-6)
        self.proj_in = nn.Conv2d(channels, channels, 1)
        self.transformer_blocks = nn.ModuleList([TransformerBlock(channels, config.heads)])
        self.proj_out = zero_weights(nn.Conv2d(channels, channels, 1))

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """The input plus what attention adds."""
        tokens = self.proj_in(self.norm(x)).flatten(2).transpose(1, 2)
        for block in self.transformer_blocks:
            tokens = block(tokens)
        return x + self.proj_out(tokens.transpose(1, 2).unflatten(-1, x.shape[2:]))


class Downsample(nn.Module):
    """Half the resolution by a convolution of stride 2."""

    def __init__(self, channels: int):
        super().__init__()
        self.op = nn.Conv2d(channels, channels, 3, stride=2, padding=1)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Tensor:
        """The smaller picture."""
        return self.op(x)


class Upsample(nn.Module):
    """Twice the resolution: nearest neighbour, then a convolution."""

    def __init__(self, channels: int):
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Tensor:
        """The larger picture."""
        return self.conv(functional.interpolate(x, scale_factor=2.0, mode="nearest"))


class UNetStage(nn.Sequential):
    """Layers in a row, of which residual blocks also get the time embedding."""

    def forward(self, x: Tensor, time: Tensor) -> Tensor:
        """The last layer's output."""
        for layer in self:
            x = layer(x, time) if isinstance(layer, ResidualBlock) else layer(x)
        return x


class SlabUNet(nn.Module):
    """x0 guess of a noisy slab [b, 56, 256, 256] at steps t [b] (paper sec. 3.3, SPEC 3)."""

    def __init__(self, config: UNetConfig = PAPER):
        super().__init__()
        self.config = config
        time_width = 4 * config.width
        self.time_embed = TimeEmbedding(config.width, time_width)
        channels = config.width
        self.input_blocks = nn.ModuleList([UNetStage(nn.Conv2d(config.slab_channels, channels, 3, padding=1))])
        skips = [channels]
        for level, multiplier in enumerate(config.multipliers):
            for _ in range(config.blocks):
                self.input_blocks.append(self._stage(channels, multiplier * config.width, level))
                channels = multiplier * config.width
                skips.append(channels)
            if level + 1 < len(config.multipliers):
                self.input_blocks.append(UNetStage(Downsample(channels)))
                skips.append(channels)
        self.middle_block = UNetStage(
            ResidualBlock(channels, channels, time_width),
            SpatialTransformer(channels, config),
            ResidualBlock(channels, channels, time_width),
        )
        self.output_blocks = nn.ModuleList()
        for level, multiplier in reversed(list(enumerate(config.multipliers))):
            for block in range(config.blocks + 1):
                stage = self._stage(channels + skips.pop(), multiplier * config.width, level)
                channels = multiplier * config.width
                if level and block == config.blocks:
                    stage.append(Upsample(channels))
                self.output_blocks.append(stage)
        self.out = nn.Sequential(
            nn.GroupNorm(32, channels), nn.SiLU(), zero_weights(nn.Conv2d(channels, config.slab_channels, 3, padding=1))
        )

    def _stage(self, channels: int, out_channels: int, level: int) -> UNetStage:
        stage = UNetStage(ResidualBlock(channels, out_channels, 4 * self.config.width))
        if level in self.config.attention_levels:
            stage.append(SpatialTransformer(out_channels, self.config))
        return stage

    def forward(self, x: Float[Tensor, "b c h w"], t: Int[Tensor, "b"]) -> Float[Tensor, "b c h w"]:
        """The x0 guess."""
        time = self.time_embed(t)
        skips = []
        for stage in self.input_blocks:
            x = stage(x, time)
            skips.append(x)
        x = self.middle_block(x, time)
        for stage in self.output_blocks:
            x = stage(torch.cat([x, skips.pop()], dim=1), time)
        return self.out(x)
