"""Codecs between payloads and samples of the diffusion: whole slabs, or latents of a linear codec per primitive.

The linear codec is the first and last layer of slab diffusion, in closed form, orthonormal and frozen. A primitive's
4 x 8^3 values (sRGB-encoded colour, density / full density; the slab's values, SPEC 3) and its delta scale become C
numbers in a basis that all primitives of a region share: what varies at the head differs from what varies at a leg.
Noise of the slab projected on orthonormal rows is standard normal again, and nothing outside the basis feeds back, so
diffusing latents is diffusing the slab with these two layers fixed.
The slab repeats a delta scale over 8^3 voxels; here it is one number of the same energy.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Protocol

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from primdiffusion.geometry.image import decode_srgb, encode_srgb
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.anchors import CHARTS, default_anchors
from primdiffusion.primitives.primitives import (
    CHANNELS_PER_LAYER,
    DELTA_SCALE_UNIT,
    GRID,
    NETWORK_SCALE,
    WINDOW_POWER,
    WINDOW_SHARPNESS,
    K,
    Payload,
    S,
    pack,
    unpack,
)

VOXEL_VALUES = 4 * S**3
VALUES = VOXEL_VALUES + 3
"""Values of a primitive: encoded red, green, blue, relative density, each D, H, W; delta scale along T, B, N."""
SCALE_VALUE = S**1.5 * DELTA_SCALE_UNIT / 255
"""Value of a delta scale of 1: the slab's, times the root of how often the slab repeats it."""
SLAB_UNIT = 2 * NETWORK_SCALE
"""Network units per value: noise on latents is the noise that the paper puts on the slab."""
DEAD_ZONE = (0.08, 0.84)
"""Decoded relative density a becomes clip((a - start) / width), which removes the haze that truncation leaves around a
person. The default for codecs that store none: fitted to payloads from meshes, at 96 numbers a primitive."""
FITTED_DEAD_ZONE = (0.03, 0.94)
"""Dead zone of codecs of fitted payloads, whose densities are exact enough for silhouettes."""
HAZE = (0.12, 0.22)
"""Largest relative density among a voxel and its neighbours: a voxel below the first is haze and becomes empty, one
above the second stays as it is. Voxels of a surface have a dense neighbour, specks beside a person have none."""
SMALLEST_DELTA_S = 0.2
"""Released values are never clamped (SPEC 1.13). Usual values are around 1; a box of five times its rest size is an
outlier, and 0 has no reciprocal."""
_B_AXIS = -2
"""The voxels' axes D, H, W run along N, B, T."""
LEAST_WEIGHT = 0.1
"""Weight of a voxel in a corner of its box, which the window all but hides."""


@dataclasses.dataclass(frozen=True)
class LinearCodec(TensorRecord):
    """Cells [*b, 1024, 2051] to latents [*b, C, 32, 32] and back: z = 0.364 basis weight (v - mean), in slab units."""

    mean: Float[Tensor, "k v"]
    """Mean values of every primitive; equal to its own mirror image."""
    basis: Float[Tensor, "b c v"]
    """Orthonormal rows of each region's basis, each row even or odd under the mirror of a cell."""
    parity: Float[Tensor, "b c"]
    """1 for even rows, -1 for odd ones."""
    region: Int[Tensor, "k"]
    """Index of the basis of every primitive; equal to its own mirror image."""
    weight: Float[Tensor, "v"] = dataclasses.field(default_factory=lambda: torch.ones(VALUES))
    """Visibility of each value in a picture; equal to its own mirror image."""
    dead_zone: Float[Tensor, "2"] = dataclasses.field(default_factory=lambda: torch.tensor(DEAD_ZONE))
    """Start and width, see DEAD_ZONE."""

    @property
    def zone(self) -> tuple[float, float]:
        """`dead_zone` as numbers."""
        start, width = self.dead_zone.tolist()
        return start, width

    @property
    def channels(self) -> int:
        """C, the latent channels of a primitive."""
        return self.basis.shape[1]

    def encode(self, cells: Float[Tensor, "*b k v"]) -> Float[Tensor, "*b c 32 32"]:
        """Project cells onto the bases of their regions; the remainder is lost."""
        values = (cells - self.mean) * self.weight
        latents = values.new_empty((*values.shape[:-1], self.channels))
        for basis, members in zip(self.basis, self._members(), strict=True):
            latents[..., members, :] = values[..., members, :] @ basis.T * SLAB_UNIT
        return latents.transpose(-1, -2).unflatten(-1, (GRID, GRID))

    def decode(self, latents: Float[Tensor, "*b c 32 32"]) -> Float[Tensor, "*b k v"]:
        """Cells of latents, unclamped."""
        coefficients = latents.flatten(-2).transpose(-1, -2) / SLAB_UNIT
        values = coefficients.new_empty((*coefficients.shape[:-1], VALUES))
        for basis, members in zip(self.basis, self._members(), strict=True):
            values[..., members, :] = coefficients[..., members, :] @ basis
        return values.div_(self.weight).add_(self.mean)  # in place: the cells of a person take 8 MB

    def pulled_back(self, slopes: Float[Tensor, "k v"]) -> Float[Tensor, "c 32 32"]:
        """Slopes on latents of a function that has these slopes on their cells, few of which it depends on."""
        latents, touched = slopes.new_zeros(K, self.channels), slopes.any(-1)
        for basis, members in zip(self.basis, self._members(), strict=True):
            own = members[touched[members]]
            latents[own] = slopes[own] / self.weight @ basis.T / SLAB_UNIT
        return latents.T.unflatten(-1, (GRID, GRID))

    def voxel_basis(self, channels: int) -> Float[Tensor, "b 512 4 c"]:
        """Change of each voxel's encoded colour and relative density per unit of the leading channels."""
        basis = self.basis[:, :channels] / (self.weight * SLAB_UNIT)
        return basis[..., :VOXEL_VALUES].unflatten(-1, (4, S**3)).permute(0, 3, 2, 1)

    def mirror(self, latents: Float[Tensor, "*b c 32 32"]) -> Float[Tensor, "*b c 32 32"]:
        """Mirror a person: columns reversed, each cell reversed along W (the layout is symmetric).

        Accepts the leading channels alone.
        """
        parity = self.parity[self.region].T.unflatten(-1, (GRID, GRID))
        return latents.flip(-1) * parity[: latents.shape[-3]]

    def _members(self) -> list[Int[Tensor, "m"]]:
        """The primitives of each basis."""
        return [(self.region == number).nonzero()[:, 0] for number in range(len(self.basis))]


def cells_from_voxels(
    voxels: UInt8[Tensor, "*b k 8 8 8 4"], delta_scale: Float[Tensor, "*b k 3"] | None = None
) -> Float[Tensor, "*b k v"]:
    """Return cells of stored voxels (encoded RGB and relative density, 0 ... 255) and delta scales (None: all 1)."""
    values = voxels.movedim(-1, -4).flatten(-4).float() / 255
    scale = values.new_ones((*values.shape[:-1], 3)) if delta_scale is None else delta_scale.float()
    return torch.cat([values, scale * SCALE_VALUE], dim=-1)


def cells_from_payload(
    payload: Payload, full_density: float, dead_zone: tuple[float, float] = DEAD_ZONE
) -> Float[Tensor, "*b k v"]:
    """Inverse of `payload_from_cells`; `full_density` (1/m) is the density stored as 1.

    Denser voxels are clamped to it. The dead zone is undone between empty and full voxels, which stay 0 and 1; haze
    that is gone stays gone.
    """
    start, width = dead_zone
    relative = (payload.density / full_density).clamp(0, 1)
    density = torch.where((relative > 0) & (relative < 1), relative * width + start, relative).unsqueeze(-4)
    voxels = torch.cat([encode_srgb(payload.rgb.clamp(0, 1)), density], dim=-4).flatten(-4)
    return torch.cat([voxels, payload.delta_scale * SCALE_VALUE], dim=-1)


def payload_from_cells(
    cells: Float[Tensor, "*b k v"], full_density: float, dead_zone: tuple[float, float] = DEAD_ZONE
) -> Payload:
    """Return the payload of decoded cells: clamped, with the dead zone applied to density, and without haze."""
    start, width = dead_zone
    voxels, scale = cells.split((VOXEL_VALUES, 3), dim=-1)
    voxels = voxels.unflatten(-1, (4, S, S, S))
    density = _without_haze(((voxels[..., 3, :, :, :] - start) / width).clamp(0, 1)) * full_density
    return Payload(decode_srgb(voxels[..., :3, :, :, :].clamp(0, 1)), density, (scale / SCALE_VALUE).clamp_min(0))


def _without_haze(density: Float[Tensor, "*b d h w"]) -> Float[Tensor, "*b d h w"]:
    """Relative densities without voxels that no neighbour in their box supports, see HAZE."""
    boxes = density.reshape(-1, 1, S, S, S)
    densest = torch.nn.functional.max_pool3d(boxes, kernel_size=3, stride=1, padding=1)
    first, second = HAZE
    return (boxes * ((densest - first) / (second - first)).clamp(0, 1)).view_as(density)


def mirror_cells(cells: Float[Tensor, "*b k v"]) -> Float[Tensor, "*b k v"]:
    """Mirror cells, as `LinearCodec.mirror` mirrors latents."""
    voxels, scale = cells.unflatten(-2, (GRID, GRID)).flip(-2).split((VOXEL_VALUES, 3), dim=-1)
    voxels = voxels.unflatten(-1, (4 * S * S, S)).flip(-1).flatten(-2)
    return torch.cat([voxels, scale], dim=-1).flatten(-3, -2)


def fit_codec(
    cells: Float[Tensor, "n k v"], channels: int, generator: torch.Generator, cells_each: int = 512
) -> LinearCodec:
    """Fit each cell's mean, and the principal components of each region in `cells_each` random cells a sample.

    Regions are the parts of `codec_regions`. Mirror images count too. Values are weighted by the marcher's window, so
    invisible values take no component.

    Raises ValueError for fewer samples than channels.
    """
    if cells.shape[0] * cells_each < channels or tuple(cells.shape[1:]) != (K, VALUES):
        raise ValueError(
            f"cells of shape {tuple(cells.shape)} cannot give {channels} components; give [n, {K}, {VALUES}]"
        )
    mean = cells.mean(0)
    mean = ((mean + mirror_cells(mean)) / 2).half().float()  # stored in half precision: encode with what is stored
    weight, region = window_weight(), codec_regions()
    count = int(region.max()) + 1
    moments = [
        [torch.zeros(half, half, dtype=torch.float64) for half in (VOXEL_VALUES // 2 + 3, VOXEL_VALUES // 2)]
        for _ in range(count)
    ]
    for person in cells:
        chosen = torch.randperm(K, generator=generator)[:cells_each]
        for number in range(count):
            members = chosen[region[chosen] == number]
            parts = _parity_parts((person[members] - mean[members]) * weight)
            for moment, part in zip(moments[number], parts, strict=True):
                moment += (part.T @ part).double()
    bases, parities = zip(*(_components(each, channels) for each in moments), strict=True)
    return LinearCodec(mean, torch.stack(bases), torch.stack(parities), region, weight, torch.tensor(FITTED_DEAD_ZONE))


@functools.cache
def codec_regions() -> Int[Tensor, "k"]:
    """The region of every primitive: torso, head, arms, hands, legs or feet; left and right are one."""
    parts = [name.removeprefix("left_").removeprefix("right_") for name in CHARTS]
    names = list(dict.fromkeys(parts))
    return torch.tensor([names.index(part) for part in parts])[default_anchors().chart.long()]


def _components(moments: Sequence[Float[Tensor, "h h"]], channels: int) -> tuple[Tensor, Tensor]:
    """Leading components [channels, v] of second moments of `_parity_parts`, and their parities."""
    variances, rows, parity = [], [], []
    for sign, moment in zip((1.0, -1.0), moments, strict=True):
        value, vector = torch.linalg.eigh(moment)
        variances.append(value)
        rows.append(_whole(vector.T.float(), sign))
        parity.append(torch.full_like(value, sign))
    order = torch.cat(variances).argsort(descending=True)[:channels]
    return torch.cat(rows)[order], torch.cat(parity)[order].float()


@functools.cache
def window_weight() -> Float[Tensor, "v"]:
    """Root of the share of each voxel's trilinear hat that the marcher's window lets through; 1 for delta scales."""
    place = torch.linspace(-1, 1, 2801, dtype=torch.float64)
    window = torch.exp(-WINDOW_SHARPNESS * place**WINDOW_POWER)
    pitch = 2 / (S - 1)
    hats = (1 - (place - torch.linspace(-1, 1, S, dtype=torch.float64)[:, None]).abs() / pitch).clamp_min(0)
    share = (hats * window).sum(1) / hats[S // 2].sum()
    voxel = (share[:, None, None] * share[:, None] * share).sqrt().clamp_min(LEAST_WEIGHT)
    return torch.cat([voxel.flatten().repeat(4), torch.ones(3, dtype=torch.float64)]).float()


def _parity_parts(values: Float[Tensor, "n v"]) -> tuple[Tensor, Tensor]:
    """Orthonormal coordinates of the parts that are even and odd along W; delta scales are even."""
    voxels, scale = values.split((VOXEL_VALUES, 3), dim=-1)
    left, right = voxels.unflatten(-1, (4 * S * S, S)).split(S // 2, dim=-1)
    right = right.flip(-1)
    return torch.cat([((left + right) / 2**0.5).flatten(-2), scale], dim=-1), ((left - right) / 2**0.5).flatten(-2)


def _whole(part: Float[Tensor, "n h"], sign: float) -> Float[Tensor, "n v"]:
    """Inverse of one of `_parity_parts`."""
    voxels, scale = part[:, : VOXEL_VALUES // 2], part[:, VOXEL_VALUES // 2 :]
    left = voxels.unflatten(-1, (4 * S * S, S // 2)) / 2**0.5
    scale = scale if sign > 0 else scale.new_zeros(len(scale), 3)
    return torch.cat([torch.cat([left, sign * left.flip(-1)], dim=-1).flatten(-2), scale], dim=-1)


class Codec(Protocol):
    """Converts between clean samples of the diffusion and payloads."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Channels, height and width of a sample."""
        ...

    def to_payload(self, x0: Tensor, full_density: float) -> Payload:
        """The payload of a clean sample [*b, *shape]."""
        ...

    def from_payload(self, payload: Payload, full_density: float) -> Tensor:
        """The clean sample [*b, *shape] nearest to a payload; may be lossy."""
        ...

    @property
    def cell_side(self) -> int:
        """Pixels a side that a primitive covers in a sample."""
        ...


@dataclasses.dataclass(frozen=True)
class CellCodec:
    """Latents of the default denoiser."""

    codec: LinearCodec

    @property
    def shape(self) -> tuple[int, int, int]:
        """[C, 32, 32]."""
        return self.codec.channels, GRID, GRID

    def to_payload(self, x0: Float[Tensor, "*b c h w"], full_density: float) -> Payload:
        """Decode; clamped, with the dead zone applied."""
        return payload_from_cells(self.codec.decode(x0), full_density, self.codec.zone)

    def from_payload(self, payload: Payload, full_density: float) -> Float[Tensor, "*b c h w"]:
        """Encode as latents; the part outside the basis is lost."""
        return self.codec.encode(cells_from_payload(payload, full_density, self.codec.zone))

    def to(self, device: torch.device | str) -> CellCodec:
        """The same on another device."""
        return CellCodec(self.codec.to(device))

    @property
    def cell_side(self) -> int:
        """1."""
        return 1


@dataclasses.dataclass(frozen=True)
class WholeSlab:
    """No codec: the slab itself is diffused, as in the paper."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """[56, 256, 256]."""
        return S * CHANNELS_PER_LAYER, GRID * S, GRID * S

    def to_payload(self, x0: Float[Tensor, "*b c h w"], full_density: float) -> Payload:
        """Unpack and clamp."""
        return unpack(x0, full_density)

    def from_payload(self, payload: Payload, full_density: float) -> Float[Tensor, "*b c h w"]:
        """Pack."""
        return pack(payload, full_density)

    @property
    def cell_side(self) -> int:
        """8."""
        return S


@dataclasses.dataclass(frozen=True)
class ReleasedSlab(WholeSlab):
    """A slab whose boxes have B = T x N, and delta_s that divides their size (SPEC 1.1, 1.8).

    Conversion flips voxels along B, so that frames stay in SO(3), and delta_scale = 1 / delta_s.
    """

    def to_payload(self, x0: Float[Tensor, "*b c h w"], full_density: float) -> Payload:
        """Unpack and clamp."""
        payload = super().to_payload(x0, full_density)
        return Payload(
            payload.rgb.flip(_B_AXIS),
            payload.density.flip(_B_AXIS),
            1 / payload.delta_scale.clamp_min(SMALLEST_DELTA_S),
        )

    def from_payload(self, payload: Payload, full_density: float) -> Float[Tensor, "*b c h w"]:
        """Pack; the inverse for boxes up to five times their rest size. Raises ValueError for boxes without size."""
        if not (payload.delta_scale > 0).all():
            raise ValueError(
                "a delta scale is 0 or less, but released slabs store its reciprocal: refine this human again"
            )
        flipped = Payload(payload.rgb.flip(_B_AXIS), payload.density.flip(_B_AXIS), 1 / payload.delta_scale)
        return super().from_payload(flipped, full_density)
