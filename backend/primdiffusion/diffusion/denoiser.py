"""The default denoiser: a closed-form person prior, whose guess of the rest is corrected by a network over the grid.

A local network is slow to learn correlations over the whole body, such as one shirt's colour on 300 primitives. So the
prior denoises the person components, which are few, and a small U-Net over the 32 x 32 grid denoises the rest.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from primdiffusion.diffusion.gaussian import PersonPrior
from primdiffusion.diffusion.schedule import Schedule

Layer = TypeVar("Layer", nn.Linear, nn.Conv2d)


def zero_weights(layer: Layer) -> Layer:
    """Set weights and bias to 0, so that a residual block that ends in the layer starts as the identity."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer


class TimeEmbedding(nn.Sequential):
    """Linear - SiLU - Linear on [cos, sin] features of the step."""

    def __init__(self, features: int, width: int):
        super().__init__(nn.Linear(features, width), nn.SiLU(), nn.Linear(width, width))
        self.features = features

    def forward(self, t: Int[Tensor, "b"]) -> Float[Tensor, "b width"]:
        """Embedding of a batch of steps."""
        return super().forward(step_features(t, self.features).to(next(self.parameters()).dtype))


def step_features(t: Int[Tensor, "b"], features: int) -> Float[Tensor, "b features"]:
    """cos and sin of t at `features` / 2 frequencies falling geometrically from 1 to 1 / 10,000."""
    half = features // 2
    frequency = torch.exp(-math.log(10_000.0) * torch.arange(half, device=t.device) / half)
    phase = t[:, None].float() * frequency
    return torch.cat([phase.cos(), phase.sin()], dim=-1)


@dataclasses.dataclass(frozen=True)
class LocalUNetConfig:
    """Size of the U-Net over the 32 x 32 grid."""

    widths: tuple[int, ...] = (192, 256, 320)
    """Channels at 32, 16 and 8 cells a side."""
    blocks: int = 1
    """Residual blocks of a level, down and up."""
    position_channels: int = 16
    """Learned feature maps that encode the cell's position on the body."""
    condition_width: int = 192
    """Features of the time and person embedding that modulate every block."""
    heads: int = 4
    """Heads of the self-attention at 8 and 16 cells a side."""
    end_kernel: int = 1
    """Kernel size of the first and last convolution. They have the most channels: 3 makes a step a third slower."""


class LocalBlock(nn.Module):
    """GroupNorm - SiLU - conv, modulated by the condition, SiLU - conv, plus the input."""

    def __init__(self, channels: int, out_channels: int, condition_width: int):
        super().__init__()
        self.norm1, self.conv1 = nn.GroupNorm(8, channels), nn.Conv2d(channels, out_channels, 3, padding=1)
        self.norm2, self.conv2 = (
            nn.GroupNorm(8, out_channels),
            zero_weights(nn.Conv2d(out_channels, out_channels, 3, padding=1)),
        )
        self.film = nn.Linear(condition_width, 2 * out_channels)
        self.skip = nn.Identity() if channels == out_channels else nn.Conv2d(channels, out_channels, 1)

    def forward(self, x: Float[Tensor, "b c h w"], condition: Float[Tensor, "b e"]) -> Float[Tensor, "b d h w"]:
        """The block's output."""
        scale, shift = self.film(condition)[:, :, None, None].chunk(2, dim=1)
        h = self.norm2(self.conv1(functional.silu(self.norm1(x)))) * (1 + scale) + shift
        return self.skip(x) + self.conv2(functional.silu(h))


class LocalAttention(nn.Module):
    """Self-attention over the cells of a level, added to the input."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norm, self.qkv, self.out = (
            nn.GroupNorm(8, channels),
            nn.Conv2d(channels, 3 * channels, 1),
            zero_weights(nn.Conv2d(channels, channels, 1)),
        )

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """The input plus what other cells add."""
        q, k, v = self.qkv(self.norm(x)).flatten(2).unflatten(1, (3, self.heads, -1)).transpose(-1, -2).unbind(1)
        mixed = functional.scaled_dot_product_attention(q, k, v).transpose(-1, -2).flatten(1, 2)
        return x + self.out(mixed.unflatten(-1, x.shape[2:]))


class LocalStage(nn.ModuleList):
    """Local blocks in a row."""

    def forward(self, x: Float[Tensor, "b c h w"], condition: Float[Tensor, "b e"]) -> Tensor:
        """The last block's output."""
        for block in self:
            x = block(x, condition)
        return x


class LocalUNet(nn.Module):
    """Correction of the closed-form guess of the rest, in standard deviations; starts at 0."""

    def __init__(
        self,
        channels: int,
        components: int,
        grid: int,
        asked_width: int,
        config: LocalUNetConfig,
        picture_channels: int | None = None,
    ):
        """`picture_channels` are the leading channels that person components live in; None is all."""
        super().__init__()
        widths, condition_width = config.widths, config.condition_width
        self.time = TimeEmbedding(64, condition_width)
        self.asked = zero_weights(nn.Linear(asked_width, condition_width, bias=False)) if asked_width else None
        self.person = nn.Linear(components, condition_width)
        self.position = nn.Parameter(0.5 * torch.randn(config.position_channels, grid, grid))
        self.picture_channels = channels if picture_channels is None else picture_channels
        seen = channels + self.picture_channels + config.position_channels
        self.inner = nn.Conv2d(seen, widths[0], config.end_kernel, padding="same")
        self.down, self.up, self.shrink, self.grow, self.attend = (nn.ModuleList() for _ in range(5))
        for level, width in enumerate(widths):
            self.down.append(LocalStage([LocalBlock(width, width, condition_width) for _ in range(config.blocks)]))
            self.up.append(
                LocalStage(
                    [LocalBlock(2 * width if i == 0 else width, width, condition_width) for i in range(config.blocks)]
                )
            )
            self.attend.append(LocalAttention(width, config.heads) if level else nn.Identity())
            if level < len(widths) - 1:
                self.shrink.append(nn.Conv2d(width, widths[level + 1], 2, stride=2))
                self.grow.append(nn.Conv2d(widths[level + 1], width, 1))
        self.norm, self.outer = (
            nn.GroupNorm(8, widths[0]),
            zero_weights(nn.Conv2d(widths[0], channels, config.end_kernel, padding="same")),
        )

    def forward(
        self,
        noisy: Float[Tensor, "b c h w"],
        picture: Float[Tensor, "b c h w"],
        person: Float[Tensor, "b r"],
        t: Int[Tensor, "b"],
        condition: Float[Tensor, "b a"] | None = None,
    ) -> Float[Tensor, "b c h w"]:
        """Return the correction for a noisy rest, given denoised person components and their contribution `picture`."""
        condition = functional.silu(embed(self.time(t), self.asked, condition) + self.person(person))
        position = self.position.expand(noisy.shape[0], -1, -1, -1)  # len would fix the batch of an exported graph
        x = self.inner(
            torch.cat([noisy, picture[:, : self.picture_channels], position], dim=1).contiguous(
                memory_format=torch.channels_last
            )
        )
        x = self._through_levels(x, condition)
        return self.outer(functional.silu(self.norm(x)))

    def _through_levels(self, x: Float[Tensor, "b c h w"], condition: Float[Tensor, "b e"]) -> Float[Tensor, "b c h w"]:
        """The features of the first level after all of them."""
        skips = []
        for level, stage in enumerate(self.down):
            x = self.attend[level](stage(x, condition))
            skips.append(x)
            if level < len(self.shrink):
                x = self.shrink[level](x)
        for level in reversed(range(len(self.up))):
            x = self.up[level](torch.cat([x, skips.pop()], dim=1), condition)
            if level:
                x = self.grow[level - 1](functional.interpolate(x, scale_factor=2.0, mode="nearest"))
        return x


def embed(
    time: Float[Tensor, "b e"], asked: nn.Linear | None, condition: Float[Tensor, "b a"] | None
) -> Float[Tensor, "b e"]:
    """Return the embedding of step and condition; None is the same as zeros: unconditional."""
    return time if asked is None or condition is None else time + asked(condition)


class PersonDenoiser(nn.Module):
    """x0 guess of noisy latents: E[c | .] of the prior, and its E[r | .] plus a learned correction.

    The correction is in units of the closed form's own posterior standard deviation, so it is of order 1 at every noise
    level and vanishes with the noise. It starts at 0: an untrained denoiser is the prior's.
    """

    component_std: Tensor
    picture_std: Tensor
    prior_parity: Tensor

    def __init__(self, config: LocalUNetConfig | None, prior: PersonPrior, schedule: Schedule):
        """`config` is the size of the network; None means the closed form alone."""
        super().__init__()
        self.config, self.schedule = config, schedule
        self.network_dtype = torch.float32
        self._prior: PersonPrior | None = None
        for field in dataclasses.fields(PersonPrior):
            self.register_buffer(f"prior_{field.name}", getattr(prior, field.name))
        component_std = prior.marginal_variance().sqrt()
        self.register_buffer("component_std", component_std, persistent=False)
        picture = prior.picture_variance(component_std**2).mean((1, 2)).sqrt().clamp_min(1e-6)
        self.register_buffer("picture_std", picture, persistent=False)
        channels, grid, components = prior.mean.shape[0], prior.mean.shape[-1], len(prior.parity)
        asked = prior.kind.shape[-1]
        drawn = prior.basis.shape[2]
        self.local = LocalUNet(channels, components, grid, asked, config, drawn) if config else None
        if self.local is not None:
            self.local = self.local.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def _load_from_state_dict(self, *arguments: Any) -> None:
        self._prior = None  # what it has computed is of the former tensors, which are overwritten
        super()._load_from_state_dict(*arguments)

    @property
    def prior(self) -> PersonPrior:
        """The closed-form part; the same object until its tensors are others, for it keeps what it computes once."""
        fields = {field.name: self.get_buffer(f"prior_{field.name}") for field in dataclasses.fields(PersonPrior)}
        if self._prior is None or any(getattr(self._prior, name) is not value for name, value in fields.items()):
            self._prior = PersonPrior(**fields)
        return self._prior

    def forward(
        self,
        x: Float[Tensor, "b c h w"],
        t: Int[Tensor, "b"],
        condition: Float[Tensor, "b a"] | None = None,
        guidance: float = 1.0,
    ) -> Float[Tensor, "b c h w"]:
        """Return the x0 guess for latents x at steps t, given `condition` (None: unconditional).

        `guidance` w makes the coefficients u + w (c - u) of the unconditional guess u and the conditional guess c (Ho
        and Salimans 2022). The rest, which takes most of the time, is the conditional guess that follows from them.
        """
        signal, _ = self.schedule.levels(t, x)
        prior = self.prior
        y, rest = prior.split(x, signal)
        coefficients = self.coefficients(y, t, condition)
        if condition is not None and guidance != 1.0:
            coefficients = torch.lerp(self.coefficients(y, t), coefficients, guidance)
        return prior.join(coefficients, self.rest(rest, coefficients, t, condition))

    def coefficients(
        self, y: Float[Tensor, "b r"], t: Int[Tensor, "b"], condition: Float[Tensor, "b a"] | None = None
    ) -> Float[Tensor, "b r"]:
        """Denoise person coefficients, in closed form."""
        return self.prior.denoise_coefficients(y, *self.schedule.levels(t, y), condition)

    def rest(
        self,
        rest: Float[Tensor, "b c h w"],
        coefficients: Float[Tensor, "b r"],
        t: Int[Tensor, "b"],
        condition: Float[Tensor, "b a"] | None = None,
    ) -> Float[Tensor, "b c h w"]:
        """Denoise the rest, given denoised person coefficients."""
        guess, deviation, correction = self.rest_parts(rest, coefficients, t, condition)
        return guess + deviation * correction

    def rest_parts(
        self,
        rest: Float[Tensor, "b c h w"],
        coefficients: Float[Tensor, "b r"],
        t: Int[Tensor, "b"],
        condition: Float[Tensor, "b a"] | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the closed-form guess, its posterior standard deviation, and the correction in units of that."""
        signal, noise = self.schedule.levels(t, rest)
        prior = self.prior
        total = torch.addcmul(noise**2, signal**2, prior.rest_variance)
        guess = rest * (signal * prior.rest_variance / total)
        total = total.sqrt()
        deviation = noise * prior.rest_variance.sqrt() / total
        if self.local is None:
            return guess, deviation, torch.zeros_like(guess)
        picture = prior.picture(coefficients) / self.picture_std[:, None, None]
        with self._precision(rest):
            correction = self.local(rest / total, picture, coefficients / self.component_std, t, condition)
        return guess, deviation, correction.float()

    def _precision(self, like: Tensor) -> torch.autocast:
        """Autocast for the network only: the closed form needs full precision."""
        return torch.autocast(like.device.type, self.network_dtype, enabled=self.network_dtype != torch.float32)
