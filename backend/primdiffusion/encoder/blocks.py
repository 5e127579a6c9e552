"""Layers of the encoder: convolutions with untied biases, and attention between two branches (SPEC 2)."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils import parametrize
from torch.nn.utils.parametrizations import weight_norm

SLOPE = 0.2
"""Negative slope of the leaky ReLU."""


class TensorNorm(nn.Module):
    """Weight normalisation over the whole tensor with a gain per output channel: w = g[channel] v / ||v|| (SPEC 2)."""

    def __init__(self, channel_axis: int) -> None:
        super().__init__()
        self.channel_axis = channel_axis

    def forward(self, gain: Tensor, direction: Tensor) -> Tensor:
        """Weight of a gain (size 1 on all axes but the channels') and a direction of the weight's shape."""
        return direction * (gain / direction.norm())

    def right_inverse(self, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Gain and direction of a weight."""
        shape = [1] * weight.ndim
        shape[self.channel_axis] = weight.shape[self.channel_axis]
        return weight.norm().expand(shape).clone(), weight


class UntiedConv(nn.Module):
    """A weight-normalised convolution with a bias [C, H, W], because each UV position is a fixed part of the body.

    `resize` is "same" (3 x 3 or 1 x 1), "down" or "up" (4 x 4, factor 2); `side` is the output's height and width, or
    1 for a bias per channel. The norm is that of each output channel's weights, or with `whole_norm` of all weights.
    """

    def __init__(
        self, inputs: int, outputs: int, side: int, resize: str = "same", kernel: int = 3, whole_norm: bool = False
    ) -> None:
        super().__init__()
        if resize == "same":
            convolution: nn.Module = nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2, bias=False)
        elif resize == "down":
            convolution = nn.Conv2d(inputs, outputs, 4, stride=2, padding=1, bias=False)
        else:
            convolution = nn.ConvTranspose2d(inputs, outputs, 4, stride=2, padding=1, bias=False)
        channel_axis = 1 if resize == "up" else 0
        if whole_norm:
            parametrize.register_parametrization(convolution, "weight", TensorNorm(channel_axis))
            self.convolution = convolution
        else:
            self.convolution = weight_norm(convolution, dim=channel_axis)
        self.bias = nn.Parameter(torch.zeros(outputs, side, side))

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o h w"]:
        """Convolution and bias, without activation."""
        return self.convolution(x) + self.bias

    def small_init_(self) -> UntiedConv:
        """Scale the weights by 0.1 in place and return self, so that a residual branch starts close to zero."""
        with torch.no_grad():
            self.convolution.get_parameter("parametrizations.weight.original0").mul_(0.1)
        return self


Conv = Callable[..., UntiedConv]
WholeNormConv: Conv = functools.partial(UntiedConv, whole_norm=True)
"""The released code's convolution."""


def rectify(x: Tensor) -> Tensor:
    """Leaky ReLU."""
    return functional.leaky_relu(x, SLOPE)


class ResidualConv(nn.Module):
    """A residual block of two convolutions."""

    def __init__(self, inputs: int, outputs: int, side: int) -> None:
        super().__init__()
        self.first = UntiedConv(inputs, outputs, side)
        self.second = UntiedConv(outputs, outputs, side)
        self.shortcut = nn.Identity() if inputs == outputs else UntiedConv(inputs, outputs, side, kernel=1)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o h w"]:
        """Output of the same size, after the activation."""
        return rectify(self.second(rectify(self.first(x))) + self.shortcut(x))


class ReleasedResidualConv(nn.Module):
    """The residual block of the released code (SPEC 2): rectified before the sum, a shortcut with a tied bias."""

    def __init__(self, inputs: int, outputs: int, side: int, kernel: int) -> None:
        super().__init__()
        self.first = WholeNormConv(inputs, inputs, side, kernel=kernel)
        self.second = WholeNormConv(inputs, outputs, side, kernel=kernel)
        self.shortcut = WholeNormConv(inputs, outputs, 1, kernel=1)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o h w"]:
        """Output of the same size."""
        return rectify(self.second(rectify(self.first(x)))) + self.shortcut(x)


class GridNetwork(nn.Module):
    """A small U-Net over the 32 x 32 grid: down to 32 / 2^(levels - 1) and back, with additive skips."""

    def __init__(self, inputs: int, channels: Sequence[int], side: int) -> None:
        super().__init__()
        self.enter = ResidualConv(inputs, channels[0], side)
        sides = [side >> level for level in range(len(channels))]
        pairs = list(itertools.pairwise(channels))
        self.down = nn.ModuleList(UntiedConv(a, b, s, "down") for (a, b), s in zip(pairs, sides[1:], strict=True))
        self.up = nn.ModuleList(
            UntiedConv(b, a, s, "up") for (a, b), s in zip(reversed(pairs), reversed(sides[:-1]), strict=True)
        )
        self.leave = UntiedConv(channels[0] + inputs, channels[0], side, kernel=1)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o h w"]:
        """Features of the grid, not rectified."""
        levels = [self.enter(x)]
        for down in self.down:
            levels.append(rectify(down(levels[-1])))
        value = levels.pop()
        for up in self.up:
            value = rectify(up(value)) + levels.pop()
        return self.leave(torch.cat([value, x], dim=1))


class HalvingGridNetwork(nn.Module):
    """The U-Net of SPEC 2: downsamples first, with additive skips below, and concatenates the input at the end.

    `channels` are those at `side`, side / 2, ...; `outputs` those of the last layer.
    """

    def __init__(
        self, inputs: int, channels: Sequence[int], side: int, outputs: int | None = None, conv: Conv = UntiedConv
    ) -> None:
        super().__init__()
        sides = [side >> level for level in range(len(channels))]
        inward = list(itertools.pairwise((inputs, *channels[1:])))
        outward = list(itertools.pairwise(reversed(channels)))
        self.down = nn.ModuleList(conv(a, b, s, "down") for (a, b), s in zip(inward, sides[1:], strict=True))
        self.up = nn.ModuleList(conv(a, b, s, "up") for (a, b), s in zip(outward, sides[-2::-1], strict=True))
        top = channels[0] if self.up else 0
        self.leave = conv(top + inputs, outputs or channels[0], side, kernel=1)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o h w"]:
        """Features of the grid, not rectified."""
        levels = [x]
        for down in self.down:
            levels.append(rectify(down(levels[-1])))
        value = levels.pop()
        for up in self.up[:-1]:
            value = rectify(up(value)) + levels.pop()
        for up in self.up[-1:]:
            value = torch.cat([rectify(up(value)), x], dim=1)
        return self.leave(value)


class Attention(nn.Module):
    """Multi-head attention from tokens to a context, which may be the tokens themselves."""

    def __init__(self, width: int, context: int, heads: int, inner: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, inner, bias=False)
        self.key_value = nn.Linear(context, 2 * inner, bias=False)
        self.out = nn.Linear(inner, width)

    def forward(self, tokens: Float[Tensor, "b n c"], context: Float[Tensor, "b m d"]) -> Float[Tensor, "b n c"]:
        """Attention output, one vector per token."""
        split = [
            part.unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for part in (self.query(tokens), *self.key_value(context).chunk(2, dim=-1))
        ]
        found = functional.scaled_dot_product_attention(*split)
        return self.out(found.transpose(1, 2).flatten(-2))


class GatedFeedForward(nn.Module):
    """GEGLU (Shazeer 2020), four times as wide inside."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.enter = nn.Linear(width, 8 * width)
        self.leave = nn.Linear(4 * width, width)

    def forward(self, tokens: Float[Tensor, "b n c"]) -> Float[Tensor, "b n c"]:
        """Apply to each token independently."""
        value, gate = self.enter(tokens).chunk(2, dim=-1)
        return self.leave(value * functional.gelu(gate))


class CrossBlock(nn.Module):
    """Cross-attention from appearance to motion tokens and back, each followed by an MLP (paper sec. 3.2)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(4))
        self.to_motion = Attention(width, width, heads, width)
        self.to_appearance = Attention(width, width, heads, width)
        self.forwards = nn.ModuleList(GatedFeedForward(width) for _ in range(2))

    def forward(
        self, appearance: Float[Tensor, "b n c"], motion: Float[Tensor, "b n c"]
    ) -> tuple[Float[Tensor, "b n c"], Float[Tensor, "b n c"]]:
        """Updated tokens of both branches."""
        a, m = self.norms[0](appearance), self.norms[1](motion)
        appearance, motion = appearance + self.to_motion(a, m), motion + self.to_appearance(m, a)
        return (
            appearance + self.forwards[0](self.norms[2](appearance)),
            motion + self.forwards[1](self.norms[3](motion)),
        )


class CrossModalAttention(nn.Module):
    """Bidirectional cross-attention between two feature maps on one grid, as a residual."""

    def __init__(self, appearance: int, motion: int, width: int, heads: int, blocks: int) -> None:
        super().__init__()
        channels = (appearance, motion)
        self.norms = nn.ModuleList(nn.GroupNorm(min(32, c), c) for c in channels)
        self.enter = nn.ModuleList(nn.Conv2d(c, width, 1) for c in channels)
        self.blocks = nn.ModuleList(CrossBlock(width, heads) for _ in range(blocks))
        self.leave = nn.ModuleList(_silent(nn.Conv2d(width, c, 1)) for c in channels)

    def forward(
        self, appearance: Float[Tensor, "b c h w"], motion: Float[Tensor, "b d h w"]
    ) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b d h w"]]:
        """Both branches again."""
        given = (appearance, motion)
        a, m = (enter(norm(x)).flatten(2).mT for enter, norm, x in zip(self.enter, self.norms, given, strict=True))
        for block in self.blocks:
            a, m = block(a, m)
        size = appearance.shape[-2:]
        a, m = (
            x + leave(tokens.mT.unflatten(-1, size)) for x, leave, tokens in zip(given, self.leave, (a, m), strict=True)
        )
        return a, m


class ConcatenatedAttention(nn.Module):
    """Self-attention over the concatenated channels of both branches, as in the released code (SPEC 2).

    `epsilon` is that of the group norm. The released code's first branch is the motion.
    """

    def __init__(
        self, appearance: int, motion: int, width: int, heads: int, blocks: int, epsilon: float = 1e-5
    ) -> None:
        super().__init__()
        channels = appearance + motion
        self.sizes = (appearance, motion)
        self.norm = nn.GroupNorm(32, channels, epsilon)
        self.enter = nn.Conv2d(channels, width, 1)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(3 * blocks))
        self.attentions = nn.ModuleList(Attention(width, width, heads, width) for _ in range(2 * blocks))
        self.forwards = nn.ModuleList(GatedFeedForward(width) for _ in range(blocks))
        self.leave = _silent(nn.Conv2d(width, channels, 1))

    def forward(
        self, appearance: Float[Tensor, "b c h w"], motion: Float[Tensor, "b d h w"]
    ) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b d h w"]]:
        """Both branches again."""
        given = torch.cat([appearance, motion], dim=1)
        tokens = self.enter(self.norm(given)).flatten(2).mT
        for number, forward in enumerate(self.forwards):
            for step in range(2):
                normed = self.norms[3 * number + step](tokens)
                tokens = tokens + self.attentions[2 * number + step](normed, normed)
            tokens = tokens + forward(self.norms[3 * number + 2](tokens))
        both = given + self.leave(tokens.mT.unflatten(-1, given.shape[-2:]))
        a, m = both.split(self.sizes, dim=1)
        return a, m


def _silent(layer: nn.Conv2d) -> nn.Conv2d:
    nn.init.zeros_(layer.weight)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer
