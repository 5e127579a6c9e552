"""The generalizable encoder (paper sec. 3.2, SPEC 2): unprojected images and the pose -> payload."""

from __future__ import annotations

import itertools

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from primdiffusion.body.model import J
from primdiffusion.encoder.blocks import (
    ConcatenatedAttention,
    Conv,
    CrossModalAttention,
    GridNetwork,
    HalvingGridNetwork,
    ReleasedResidualConv,
    ResidualConv,
    UntiedConv,
    WholeNormConv,
    rectify,
)
from primdiffusion.encoder.config import EncoderConfig
from primdiffusion.encoder.unproject import SIDE, Unprojected
from primdiffusion.geometry.image import decode_srgb
from primdiffusion.geometry.rotation import matrix_to_axis_angle
from primdiffusion.primitives.primitives import GRID, Payload, S

MOTION = 3 * (J - 1)
"""Inputs of the motion branch: axis-angles of all joints except the pelvis, which only rotates the whole body."""
CONSTANT_BASE = 100 / 255
"""Base value of the paper's networks (SPEC 2: relu(25 x + 100))."""
RELEASED_EPSILON = 1e-6
"""Epsilon of the released code's group norm (SPEC 2)."""
B_AXIS = -2
"""The voxels' axes D, H, W run along N, B, T."""
HULL_BASE = (0.8, -0.5)
"""Initial relative density of a voxel with mask coverage c: clamp(0.8 c - 0.5). Interpolation extends an inner voxel
half way to its outer neighbour, so a larger value would enlarge silhouettes."""


class Encoder(nn.Module):
    """Two branches, attention between them, three mapping networks."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        released = config.compat == "released"
        conv: Conv = WholeNormConv if released else UntiedConv
        first, second, third = config.stem
        self.stem = nn.ModuleList(
            [
                conv(config.channels, first, SIDE // 2, "down"),
                conv(first, second, SIDE // 4, "down"),
                conv(second, third, SIDE // 8, "down"),
            ]
        )
        if config.grid_entry == "halving":
            self.appearance: nn.Module = HalvingGridNetwork(third, config.grid, GRID, config.appearance_channels, conv)
        else:
            self.appearance = GridNetwork(third, config.grid, GRID)
        branches = config.appearance_channels, config.motion
        self.motion: nn.Module = (
            ReleasedResidualConv(MOTION, config.motion, GRID, kernel=1)
            if released
            else ResidualConv(MOTION, config.motion, GRID)
        )
        first, second = branches[::-1] if released else branches
        heads = config.attention_width, config.attention_heads
        self.attention: nn.Module | None = None
        if config.attention == "cross":
            self.attention = CrossModalAttention(first, second, *heads, config.attention_blocks)
        elif config.attention == "concatenated":
            epsilon = RELEASED_EPSILON if released else 1e-5
            self.attention = ConcatenatedAttention(first, second, *heads, config.attention_blocks, epsilon)
        self.fuse: nn.Module = (
            ReleasedResidualConv(sum(branches), config.fused, GRID, kernel=3)
            if released
            else ResidualConv(sum(branches), config.fused, GRID)
        )
        self.colour = MappingNetwork(config, config.colour, 3 * S, conv)
        self.density = MappingNetwork(config, config.density, S, conv)
        scale = (config.fused, *config.scale)
        self.scale = nn.ModuleList(conv(a, b, GRID) for a, b in itertools.pairwise(scale))
        self.scale_out = conv(scale[-1], config.scale_outputs, GRID).small_init_()

    def forward(self, found: Unprojected, axis_angle: Float[Tensor, "b 24 3"]) -> Payload:
        """Payloads [b] from unprojected images [b, d, ...] and the poses of the subjects.

        Raises:
            ValueError: the input does not match this encoder's configuration, or the number of poses is wrong.
        """
        self._check(found, axis_angle)
        x, base = self.read(found)
        fine = [x]
        for stem in self.stem:
            fine.append(rectify(stem(fine[-1])))
        config = self.config
        appearance = self.appearance(fine[3])
        if config.grid_gain != 1:
            appearance = config.grid_gain * appearance
        motion = axis_angle[:, 1:].to(x).flatten(1)[:, :, None, None].expand(-1, -1, GRID, GRID)
        motion = self.motion(motion)
        branches = (motion, appearance) if config.compat == "released" else (appearance, motion)
        if self.attention is not None:
            branches = self.attention(*branches)
        fused = self.fuse(torch.cat(branches, dim=1))
        colour = clamp(base[:, : 3 * S] + config.colour_gain * self.colour(fused, fine))
        density = clamp(base[:, 3 * S :] + config.density_gain * self.density(fused, fine))
        value = fused
        for layer in self.scale:
            value = rectify(layer(value))
        logarithm = config.scale_gain * self.scale_out(value)[:, -3:]
        if config.delta_scale == "shared":
            logarithm = logarithm.mean((-1, -2), keepdim=True).expand_as(logarithm)
        rgb, filled = decode_srgb(voxels(colour, 3)), config.full_density * voxels(density, 1)[:, :, 0]
        if config.compat == "released":
            rgb, filled, logarithm = rgb.flip(B_AXIS), filled.flip(B_AXIS), -logarithm
        return Payload(rgb, filled, logarithm.exp().flatten(2).mT * found.extent)

    def read(self, found: Unprojected) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b 32 h w"]]:
        """Input of the image encoder, and base values of colours (d, c) and densities (d); sRGB-encoded, 0 ... 1.

        With `unseen` "filled" the input is -1 ... 1: colours, visibility and, for voxels, mask coverage; with "black"
        it is colours only, 0 ... 1.
        """
        dtype = self.scale_out.bias.dtype
        seen, covered = found.seen.to(dtype) / 255, found.covered.to(dtype) / 255
        rgb = found.rgb.to(dtype) / 255
        if self.config.unseen == "black":
            inputs = rgb.flatten(1, 2)
        else:
            rgb = fill(rgb, seen)
            masks = [seen, covered] if self.config.appearance == "voxels" else [seen]
            inputs = torch.cat([rgb.flatten(1, 2), *masks], dim=1) * 2 - 1
        if self.config.base == "constant":
            base = rgb.new_full((len(rgb), 4 * S, SIDE, SIDE), CONSTANT_BASE)
        else:
            slope, offset = HULL_BASE
            base = torch.cat(
                [rgb.expand(-1, S, -1, -1, -1).flatten(1, 2), (slope * covered + offset).expand(-1, S, -1, -1)], dim=1
            )
        return inputs, base

    def _check(self, found: Unprojected, axis_angle: Tensor) -> None:
        given, expected = tuple(found.seen.shape), (self.config.layers, SIDE, SIDE)
        if len(given) != 4 or given[1:] != expected:
            raise ValueError(
                f"the unprojected input has shape {given}, not [b, {', '.join(map(str, expected))}] as for "
                f"{self.config.appearance}: unproject with this encoder's configuration, and stack subjects"
            )
        if tuple(axis_angle.shape) != (given[0], J, 3):
            raise ValueError(
                f"the input has {given[0]} subjects, but axis-angles have shape {tuple(axis_angle.shape)}: "
                f"give [{given[0]}, {J}, 3]"
            )


class MappingNetwork(nn.Module):
    """Upsample 32 x 32 features to voxel values at 256 x 256: `layers` channels, depth slowest."""

    def __init__(self, config: EncoderConfig, channels: tuple[int, int], layers: int, conv: Conv) -> None:
        super().__init__()
        middle, fine = channels
        self.skips = None
        if config.detail == "skips":
            self.skips = nn.ModuleList(
                [
                    UntiedConv(config.stem[1], middle, SIDE // 4, kernel=1),
                    UntiedConv(config.stem[0], fine, SIDE // 2, kernel=1),
                    UntiedConv(config.channels, layers, SIDE, kernel=1).small_init_(),
                ]
            )
        finest = config.finest if self.skips is not None else layers
        self.up = nn.ModuleList(
            [
                conv(config.fused, middle, SIDE // 4, "up"),
                conv(middle, fine, SIDE // 2, "up"),
                conv(fine, finest, SIDE, "up"),
            ]
        )
        self.out = UntiedConv(finest, layers, SIDE).small_init_() if self.skips is not None else None

    def forward(self, fused: Float[Tensor, "b c 32 32"], fine: list[Tensor]) -> Float[Tensor, "b l 256 256"]:
        """`fine` holds the image encoder's levels, starting with its input; used only with skips."""
        first, second, third = self.up
        if self.skips is None or self.out is None:
            return third(rectify(second(rectify(first(fused)))))
        value = rectify(first(fused) + self.skips[0](fine[2]))
        value = rectify(second(value) + self.skips[1](fine[1]))
        return self.out(rectify(third(value))) + self.skips[2](fine[0])


def voxels(picture: Float[Tensor, "b dc 256 256"], channels: int) -> Float[Tensor, "b k c 8 8 8"]:
    """Pictures of 8 * c channels as primitives: channel = d * c + i, row = ny * 8 + h, column = nx * 8 + w (SPEC 2)."""
    cells = picture.unflatten(1, (S, channels)).unflatten(-1, (GRID, S)).unflatten(-3, (GRID, S))  # b d c ny h nx w
    return cells.permute(0, 3, 5, 2, 1, 4, 6).flatten(1, 2)


def motion_of(joint_rotation: Float[Tensor, "*b 24 3 3"]) -> Float[Tensor, "*b 24 3"]:
    """The motion branch's input of a pose: axis-angles, radians."""
    return matrix_to_axis_angle(joint_rotation)


class _Clamp(torch.autograd.Function):
    """Clamp to 0 ... 1; outside, pass gradients that point back into the range, so that values do not get stuck."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.clamp(0, 1)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        blocked = ((x < 0) & (gradient > 0)) | ((x > 1) & (gradient < 0))
        return gradient.masked_fill(blocked, 0)


def clamp(x: Tensor) -> Tensor:
    """Clamp `x` to 0 ... 1; gradients outside the range pass only if they point back into it."""
    return _Clamp.apply(x)


def fill(rgb: Float[Tensor, "b d c h w"], seen: Float[Tensor, "b d h w"]) -> Float[Tensor, "b d c h w"]:
    """Inpaint colours of points that no view sees: from the same column, then from increasingly large surroundings."""
    weight = seen[:, :, None]
    total, weights = (rgb * weight).sum(1), weight.sum(1)
    coarser = [(total, weights)]
    while coarser[-1][0].shape[-1] > 1:
        coarser.append((functional.avg_pool2d(coarser[-1][0], 2), functional.avg_pool2d(coarser[-1][1], 2)))
    value = coarser[-1][0] / coarser[-1][1].clamp_min(1e-6)
    for level, (part, share) in reversed(list(enumerate(coarser[:-1]))):
        value = functional.interpolate(value, size=part.shape[-2:], mode="bilinear" if level else "nearest")
        known = (share * 8).clamp(max=1)
        value = known * part / share.clamp_min(1e-6) + (1 - known) * value
    known = (weight * 8).clamp(max=1)
    return known * rgb + (1 - known) * value[:, None]
