"""A convolutional decoder of latents: it adds the detail that usually goes with what the linear codec keeps.

The linear codec decodes each cell alone, and blurs it. But a cell's place on the body and its neighbours tell much
about the detail of faces, hems and silhouettes: which skin, which collar. The detail decoder is a U-Net over the
32 x 32 cells, trained to predict payloads that are fitted to renders (`training/detail.py`) from the latents of the
same humans. Diffusion stays in the latents (Rombach et al. 2022); the decoder runs once for each human.
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from primdiffusion.diffusion.codec import CellCodec, LinearCodec, cells_from_payload, payload_from_cells
from primdiffusion.diffusion.local_unet import GridUNet, zeroed
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import GRID, Payload

SUMMARY = 4
"""The latents are averaged over a grid of this many cells a side, for the features that modulate every block."""
FAINT, SOLID = 0.05, 0.15
"""Relative densities of `without_haze`. Higher ones cut into soft outlines: on 16 held-out humans, 0.1 and 0.3 cost
0.1 dB, these nothing."""


@dataclasses.dataclass(frozen=True)
class DetailConfig:
    """Size of a detail decoder."""

    widths: tuple[int, ...] = (64, 128, 192)
    """Channels at 32, 16 and 8 cells a side."""
    position_channels: int = 16
    """Learned feature maps that encode the cell's position on the body."""
    condition_width: int = 128
    """Features of the summary of the human that modulate every block."""
    heads: int = 4
    """Heads of the self-attention at 8 and 16 cells a side."""


class DetailDecoder(GridUNet):
    """Latents of the diffusion to those of a finer codec: a linear map of each cell, plus a U-Net that starts at 0."""

    latent_std: Tensor
    rest_std: Tensor

    def __init__(self, channels: int, fine_channels: int, config: DetailConfig):
        super().__init__()
        self.config = config
        widths, wide = config.widths, config.condition_width
        self.linear = nn.Conv2d(channels, fine_channels, 1, bias=False)
        self.register_buffer("latent_std", torch.ones(channels))
        self.register_buffer("rest_std", torch.ones(fine_channels))
        self.position = nn.Parameter(0.5 * torch.randn(config.position_channels, GRID, GRID))
        self.summary = nn.Sequential(nn.Linear(channels * SUMMARY**2, wide), nn.SiLU(), nn.Linear(wide, wide))
        self.inner = nn.Conv2d(channels + config.position_channels, widths[0], 1)
        self.gain, self.shift = (nn.Parameter(torch.full((widths[0], GRID, GRID), value)) for value in (1.0, 0.0))
        self.add_levels(widths, 1, wide, config.heads)
        self.norm = nn.GroupNorm(8, widths[0])
        self.last_gain, self.last_shift = (
            nn.Parameter(torch.full((widths[0], GRID, GRID), value)) for value in (1.0, 0.0)
        )
        self.outer = zeroed(nn.Conv2d(widths[0], fine_channels, 1))

    def forward(self, latents: Float[Tensor, "b c 32 32"]) -> Float[Tensor, "b d 32 32"]:
        """Latents of the finer codec."""
        seen = latents / self.latent_std[:, None, None]
        condition = functional.silu(self.summary(functional.adaptive_avg_pool2d(seen, SUMMARY).flatten(1)))
        position = self.position.expand(len(seen), -1, -1, -1)
        x = self.inner(torch.cat([seen, position], dim=1).contiguous(memory_format=torch.channels_last))
        x = x * self.gain + self.shift
        x = self.through_levels(x, condition)
        x = self.norm(x) * self.last_gain + self.last_shift
        return self.linear(latents) + self.rest_std[:, None, None] * self.outer(functional.silu(x))


@dataclasses.dataclass(frozen=True)
class FineCodec(TensorRecord):
    """What a detail decoder's output means, and the way back."""

    codec: LinearCodec
    """Of the decoder's output; fitted to payloads that are fitted to renders."""
    back: Float[Tensor, "c c"]
    """From the coarse codec's latents of such payloads to latents of the diffusion, least squares."""


@dataclasses.dataclass(frozen=True)
class DetailCodec(CellCodec):
    """Latents of the default denoiser with a detail decoder; `codec` is the coarse codec of the latents."""

    fine: FineCodec
    decoder: DetailDecoder

    def to(self, device: torch.device | str) -> DetailCodec:
        """The same on another device; moves the decoder in place."""
        return DetailCodec(self.codec.to(device), self.fine.to(device), self.decoder.to(device))

    def to_payload(self, x0: Float[Tensor, "*b c h w"], full_density: float) -> Payload:
        """Decode; clamped, with the dead zone of the finer codec applied and without haze."""
        with torch.no_grad():
            latents = self.decoder(x0.reshape(-1, *x0.shape[-3:]))
        cells = self.fine.codec.decode(latents.reshape(*x0.shape[:-3], *latents.shape[1:]))
        return without_haze(payload_from_cells(cells, full_density, self.fine.codec.zone), full_density)

    def from_payload(self, payload: Payload, full_density: float) -> Float[Tensor, "*b c h w"]:
        """The nearest latents; what they do not keep is lost."""
        latents = self.codec.encode(cells_from_payload(payload, full_density, self.fine.codec.zone))
        return torch.einsum("dc,...chw->...dhw", self.fine.back, latents)


def without_haze(payload: Payload, full_density: float) -> Payload:
    """A copy without faint voxels that have no denser one beside them in their box: specks around hair and collars.

    Voxels whose densest neighbour is below FAINT of `full_density` (1/m) become empty, and keep their density from
    SOLID on. What is faint on a surface stays: it makes outlines soft.
    """
    relative = payload.density.flatten(0, -4)[:, None] / full_density
    densest = functional.max_pool3d(relative, 3, stride=1, padding=1).reshape(payload.density.shape)
    kept = ((densest - FAINT) / (SOLID - FAINT)).clamp(0, 1)
    return dataclasses.replace(payload, density=payload.density * kept)
