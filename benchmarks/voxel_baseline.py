"""The paper's Table 2 baseline: the same diffusion on 64^3 voxels instead of primitives.

As in the default model, a frozen orthonormal linear codec encodes cells (here blocks of 4^3 voxels), and two networks
correct a closed-form prior: one for the whole human, and a U-Net (here 3D) for the cells.

Grids are of humans in T pose and share one bounding box. The marcher renders a grid as one large primitive.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numba
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from primdiffusion.diffusion.codec import DEAD_ZONE, SLAB_UNIT
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.gaussian import PersonPrior
from primdiffusion.diffusion.model import ShapePrior
from primdiffusion.diffusion.samplers import SAMPLERS
from primdiffusion.diffusion.schedule import SCHEDULES
from primdiffusion.diffusion.unet import TimeEmbedding, zero_weights
from primdiffusion.files.whole_files import atomic_path
from primdiffusion.geometry.image import decode_srgb, encode_srgb
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import WINDOW_POWER, WINDOW_SHARPNESS, Frames, Payload, Primitives
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional

SIDE = 64
"""Voxels along each axis (paper Table 2)."""
SAMPLES = (3, 3, 1)
"""Samples along x, y, z that a voxel averages: voxels are wide in x and y and thin in depth."""
FAINT = 1e-3
"""Colour weight of empty samples, relative to full density: gives empty voxels the colour of the boxes around them."""
UNSEEN = 0.5
"""Encoded colour of voxels outside all boxes."""
FACE = 0.96
"""Local coordinate beyond which the grid is always empty; the marcher's window is not compensated there."""

BOUNDS = ((-1.06, -1.43, -0.21), (1.06, 0.81, 0.30))
"""Lowest and highest corner of the bounding box, metres from the pelvis: centres of the outermost voxels. The boxes of
a thousand samples span (-1.01, -1.36, -0.19) to (1.01, 0.75, 0.27); symmetric in x, so that grids can be mirrored."""
BLOCK = 4
"""Side of a cell, voxels."""
BLOCKS = SIDE // BLOCK
VALUES = 4 * BLOCK**3
CELLS_EACH = 256
"""Cells of each sample that the principal components are fitted to."""
SCHEDULE = "fine_linear"
"""The default model's."""


def voxelise(
    frames: Frames, rgb: Float[Tensor, "n k 3 s s s"], density: Float[Tensor, "k s s s"], full: float
) -> UInt8[Tensor, "n 64 64 64 4"]:
    """Voxelise one geometry in n colourings: grids (z, y, x) of encoded colour and density / `full`.

    A voxel averages the marcher's field (SPEC 4) over `SAMPLES` points: the sum of the boxes' windowed densities, and
    their density-weighted colour.
    """
    colours = rgb.movedim(0, 1).flatten(1, 2)
    values = torch.cat([density[:, None], colours], dim=1).movedim(1, -1).contiguous().float().numpy()
    low, high = (np.array(corner) for corner in BOUNDS)
    fine = np.array(SAMPLES) * (SIDE - 1) / (high - low)
    total = np.zeros((SIDE, SIDE, SIDE, values.shape[-1] + 1), np.float32)
    _gather(
        total,
        values,
        frames.position.double().numpy(),
        frames.rotation.double().numpy(),
        frames.half_extent.double().numpy(),
        low,
        fine,
        np.array(SAMPLES),
        full * FAINT,
    )
    grid = torch.from_numpy(total)
    weight = grid[..., -1:]
    colour = torch.where(weight > 0, encode_srgb((grid[..., 1:-1] / weight.clamp_min(1e-9)).clamp(0, 1)), UNSEEN)
    opacity = (grid[..., :1] / (math.prod(SAMPLES) * full)).clamp(0, 1)
    grids = [torch.cat([part, opacity], dim=-1) for part in colour.split(3, dim=-1)]
    return (torch.stack(grids) * 255).round().to(torch.uint8)


@numba.njit(cache=True, nogil=True)
def _gather(total, values, position, rotation, half_extent, low, fine, samples, faint):
    """Accumulate each box's density, weighted colours and weights at the fine points inside it."""
    side, size, channels = total.shape[0], values.shape[1], values.shape[-1]
    first, last, local = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3)
    corner, far = np.empty(3, np.int64), np.empty(3)
    value = np.empty(channels)
    for k in range(len(position)):
        for axis in range(3):
            reach = 0.0
            for j in range(3):
                reach += abs(rotation[k, axis, j]) * half_extent[k, j]
            shift = samples[axis] // 2
            first[axis] = max(int(np.ceil((position[k, axis] - reach - low[axis]) * fine[axis])) + shift, 0)
            last[axis] = min(
                int(np.floor((position[k, axis] + reach - low[axis]) * fine[axis])) + shift, side * samples[axis] - 1
            )
        for iz in range(first[2], last[2] + 1):
            for iy in range(first[1], last[1] + 1):
                for ix in range(first[0], last[0] + 1):
                    x = low[0] + (ix - samples[0] // 2) / fine[0] - position[k, 0]
                    y = low[1] + (iy - samples[1] // 2) / fine[1] - position[k, 1]
                    z = low[2] + (iz - samples[2] // 2) / fine[2] - position[k, 2]
                    inside, fading = True, 0.0
                    for j in range(3):
                        local[j] = (rotation[k, 0, j] * x + rotation[k, 1, j] * y + rotation[k, 2, j] * z) / (
                            half_extent[k, j]
                        )
                        if abs(local[j]) >= 1:
                            inside = False
                            break
                        fading += local[j] ** WINDOW_POWER
                    if not inside:
                        continue
                    for j in range(3):
                        place = (local[j] + 1) / 2 * (size - 1)
                        corner[j] = min(int(place), size - 2)
                        far[j] = place - corner[j]
                    value[:] = 0.0
                    for d in range(2):
                        for h in range(2):
                            for w in range(2):
                                share = (
                                    (far[0] if w else 1 - far[0])
                                    * (far[1] if h else 1 - far[1])
                                    * (far[2] if d else 1 - far[2])
                                )
                                voxel = values[k, corner[2] + d, corner[1] + h, corner[0] + w]
                                for c in range(channels):
                                    value[c] += share * voxel[c]
                    window = np.exp(-WINDOW_SHARPNESS * fading)
                    weight = window * (value[0] + faint)
                    cell = total[iz // samples[2], iy // samples[1], ix // samples[0]]
                    cell[0] += window * value[0]
                    for c in range(1, channels):
                        cell[c] += weight * value[c]
                    cell[channels] += weight


def voxelise_payload(frames: Frames, payload: Payload, full: float) -> UInt8[Tensor, "64 64 64 4"]:
    """Voxelise one human, including its delta scales."""
    placed = Primitives.place(frames, payload)
    boxes = Frames(placed.position, placed.rotation, placed.half_extent)
    return voxelise(boxes, payload.rgb[None], payload.density, full)[0]


def primitives_of(grid: Float[Tensor, "64 64 64 4"], full: float) -> Primitives:
    """Convert a grid (clamped to [0, 1]) to one primitive for `march`.

    The marcher's window fades boxes towards their faces; densities are divided by it to compensate.
    """
    grid = grid.clamp(0, 1)
    low, high = torch.tensor(BOUNDS, dtype=grid.dtype)
    along = torch.linspace(-1, 1, SIDE, dtype=grid.dtype).clamp(-FACE, FACE).pow(WINDOW_POWER)
    z, y, x = torch.meshgrid(along, along, along, indexing="ij")
    unfade = (WINDOW_SHARPNESS * (x + y + z)).exp()
    return Primitives(
        position=((low + high) / 2)[None],
        rotation=torch.eye(3, dtype=grid.dtype)[None],
        half_extent=((high - low) / 2)[None],
        rgb=decode_srgb(grid[..., :3]).movedim(-1, 0)[None].contiguous(),
        density=(grid[..., 3] * full * unfade)[None],
    )


@dataclasses.dataclass(frozen=True)
class VoxelCodec(TensorRecord):
    """Encodes grids as latents [*b, C, n, 1] of the n cells that any training sample occupies; as `LinearCodec`."""

    cells: Int[Tensor, "n"]
    """Indices among the 16^3 cells (z, y, x), ascending; the other cells are always empty."""
    mirrored: Int[Tensor, "n"]
    """Index in `cells` of each cell's mirror image."""
    mean: Float[Tensor, "n v"]
    basis: Float[Tensor, "c v"]
    """Orthonormal rows, each even or odd in x."""
    parity: Float[Tensor, "c"]

    def encode(self, grids: UInt8[Tensor, "*b 64 64 64 4"]) -> Float[Tensor, "*b c n 1"]:
        """Encode stored grids."""
        values = blocks_of(grids)[..., self.cells, :].float() / 255
        return ((values - self.mean) @ self.basis.T * SLAB_UNIT).mT[..., None]

    def decode(self, latents: Float[Tensor, "*b c n 1"]) -> Float[Tensor, "*b 64 64 64 4"]:
        """Decode to grids in [0, 1], with the same dead zone on density as primitives."""
        values = latents[..., 0].mT @ self.basis / SLAB_UNIT + self.mean
        blocks = values.new_zeros((*values.shape[:-2], BLOCKS**3, VALUES))
        blocks[..., self.cells, :] = values
        grid = blocks.unflatten(-1, (BLOCK, BLOCK, BLOCK, 4)).unflatten(-5, (BLOCKS, BLOCKS, BLOCKS))
        grid = grid.movedim((-4, -3, -2), (-6, -4, -2)).flatten(-3, -2).flatten(-4, -3).flatten(-5, -4)
        start, width = DEAD_ZONE
        return torch.cat([grid[..., :3], (grid[..., 3:] - start) / width], dim=-1).clamp(0, 1)

    def mirror(self, latents: Float[Tensor, "*b c n 1"]) -> Float[Tensor, "*b c n 1"]:
        """Latents of the grids mirrored in x."""
        return latents[..., self.mirrored, :] * self.parity[:, None, None]


def blocks_of(grids: Tensor) -> Tensor:
    """Split grids [*b, 64, 64, 64, 4] into cells [*b, 16^3, 256]; a cell's values run over z, y, x and channel."""
    split = grids.unflatten(-2, (BLOCKS, BLOCK)).unflatten(-4, (BLOCKS, BLOCK)).unflatten(-6, (BLOCKS, BLOCK))
    return split.movedim((-6, -4, -2), (-4, -3, -2)).flatten(-4).flatten(-4, -2)


def fit_voxel_codec(people: Callable[[], Iterable[UInt8[Tensor, "n 64 64 64 4"]]], channels: int) -> VoxelCodec:
    """Fit occupied cells, their means, and principal components shared by all cells, on samples and mirror images.

    `people` yields the grids of one file after another; it is called twice.
    """
    count, total = 0, torch.zeros(BLOCKS**3, VALUES)
    occupied = torch.zeros(BLOCKS**3, dtype=torch.bool)
    for grids in people():
        values = blocks_of(torch.cat([grids, grids.flip(-2)])).float() / 255
        occupied |= (values[..., 3::4] > 0).any(-1).any(0)
        total += values.sum(0)
        count += len(values)
    cells = occupied.nonzero()[:, 0]
    mean = total[cells] / count
    index_of = torch.full((BLOCKS**3,), -1)
    index_of[cells] = torch.arange(len(cells))
    moment, generator = torch.zeros(VALUES, VALUES, dtype=torch.float64), torch.Generator().manual_seed(0)
    for grids in people():
        chosen = torch.randperm(len(cells), generator=generator)[:CELLS_EACH]
        part = (blocks_of(grids)[:, cells[chosen]].float() / 255 - mean[chosen]).flatten(0, 1)
        moment += (part.T @ part).double()
    basis, parity = _components(moment, channels)
    mirrored = index_of[(cells - cells % BLOCKS) + (BLOCKS - 1 - cells % BLOCKS)]
    return VoxelCodec(cells, mirrored, mean, basis, parity)


def _components(moment: Float[Tensor, "v v"], channels: int) -> tuple[Tensor, Tensor]:
    """Principal components of the even and of the odd subspace, largest first, and their parity."""
    signs, sides = torch.linalg.eigh(_flipped(torch.eye(VALUES, dtype=moment.dtype)))  # -1 for odd, 1 for even
    variances, rows, parity = [], [], []
    for sign in (-1.0, 1.0):
        side = sides[:, signs * sign > 0]
        value, vector = torch.linalg.eigh(side.T @ moment @ side)
        variances.append(value)
        rows.append((side @ vector).T)
        parity.append(torch.full_like(value, sign))
    order = torch.cat(variances).argsort(descending=True)[:channels]
    return torch.cat(rows)[order].float().contiguous(), torch.cat(parity)[order].float()


def _flipped(values: Float[Tensor, "n 256"]) -> Float[Tensor, "n 256"]:
    """Cells whose voxels are reversed in x."""
    return values.unflatten(-1, (BLOCK**2, BLOCK, 4)).flip(-2).flatten(-3)


class VoxelBlock(nn.Module):
    """3D residual block: GroupNorm, SiLU, conv, modulation by the condition, SiLU, conv."""

    def __init__(self, channels: int, out_channels: int, condition_width: int):
        super().__init__()
        self.norm1, self.conv1 = nn.GroupNorm(8, channels), nn.Conv3d(channels, out_channels, 3, padding=1)
        self.norm2 = nn.GroupNorm(8, out_channels)
        self.conv2 = nn.Conv3d(out_channels, out_channels, 3, padding=1)
        for parameter in self.conv2.parameters():
            nn.init.zeros_(parameter)
        self.film = nn.Linear(condition_width, 2 * out_channels)
        self.skip = nn.Identity() if channels == out_channels else nn.Conv3d(channels, out_channels, 1)

    def forward(self, x: Float[Tensor, "b c d h w"], condition: Float[Tensor, "b e"]) -> Float[Tensor, "b o d h w"]:
        """Apply the block."""
        scale, shift = self.film(condition)[:, :, None, None, None].chunk(2, dim=1)
        h = self.norm2(self.conv1(functional.silu(self.norm1(x)))) * (1 + scale) + shift
        return self.skip(x) + self.conv2(functional.silu(h))


@dataclasses.dataclass(frozen=True)
class VoxelUNetConfig:
    """Size of the U-Net."""

    widths: tuple[int, ...] = (32, 64, 128)
    """Channels at 16, 8 and 4 cells a side."""
    condition_width: int = 192


class VoxelUNet(nn.Module):
    """`LocalUNet` on the 3D grid of cells, with linear layers from and to each cell's latents."""

    cells: Tensor

    def __init__(self, channels: int, components: int, cells: Int[Tensor, "n"], config: VoxelUNetConfig):
        super().__init__()
        widths, condition_width = config.widths, config.condition_width
        self.register_buffer("cells", cells, persistent=False)
        self.time, self.person = TimeEmbedding(64, condition_width), nn.Linear(components, condition_width)
        self.inner = nn.Linear(2 * channels, widths[0])
        self.position = nn.Parameter(0.5 * torch.randn(len(cells), widths[0]))
        pairs = list(pairwise(widths))
        self.down = nn.ModuleList(VoxelBlock(width, width, condition_width) for width in widths)
        self.up = nn.ModuleList(VoxelBlock(2 * width, width, condition_width) for width in widths)
        self.shrink = nn.ModuleList(nn.Conv3d(width, wider, 2, stride=2) for width, wider in pairs)
        self.grow = nn.ModuleList(nn.Conv3d(wider, width, 1) for width, wider in pairs)
        self.norm, self.outer = nn.LayerNorm(widths[0]), zero_weights(nn.Linear(widths[0], channels))

    def forward(
        self,
        noisy: Float[Tensor, "b c n 1"],
        picture: Float[Tensor, "b c n 1"],
        person: Float[Tensor, "b r"],
        t: Int[Tensor, "b"],
        condition: None = None,
    ) -> Float[Tensor, "b c n 1"]:
        """Predict the correction of the noisy residual, given the prior's reconstruction; `condition` is unused."""
        modulation = functional.silu(self.time(t) + self.person(person))
        tokens = self.inner(torch.cat([noisy, picture], dim=1)[..., 0].mT) + self.position
        grid = tokens.new_zeros((len(tokens), BLOCKS**3, tokens.shape[-1]))
        grid = grid.index_copy(1, self.cells, tokens).mT.unflatten(-1, (BLOCKS, BLOCKS, BLOCKS))
        x, skips = grid.contiguous(memory_format=torch.channels_last_3d), []
        for level, block in enumerate(self.down):
            x = block(x, modulation)
            skips.append(x)
            if level < len(self.shrink):
                x = self.shrink[level](x)
        for level in reversed(range(len(self.up))):
            x = self.up[level](torch.cat([x, skips.pop()], dim=1), modulation)
            if level:
                x = self.grow[level - 1](functional.interpolate(x, scale_factor=2.0, mode="nearest"))
        return self.outer(self.norm(x.flatten(2).mT[:, self.cells])).mT[..., None]


class VoxelPerson(NamedTuple):
    """A sample."""

    grid: Float[Tensor, "64 64 64 4"]
    betas: Float[Tensor, "10"]
    """Shape of a body that suits the grid, to frame it and to know where its joints are."""


@dataclasses.dataclass(frozen=True)
class VoxelModel:
    """A trained voxel baseline."""

    denoiser: PersonDenoiser
    codec: VoxelCodec
    shapes: ShapePrior
    full_density: float
    """Density that a stored value of 1 encodes, 1/m."""
    card: dict[str, object]
    """Training data and duration."""

    def sample(self, seeds: Sequence[int], steps: int = 30) -> Iterator[VoxelPerson]:
        """Sample a person for each seed with DDIM, starting as `DiffusionModel.start` does."""
        schedule, prior = self.denoiser.schedule, self.denoiser.prior
        chain = dense_steps(schedule.length, steps)

        def denoise(x: Tensor, t: int) -> Tensor:
            with torch.inference_mode():
                return self.denoiser(x, torch.full((len(x),), t))

        for seed in seeds:
            generator = torch.Generator().manual_seed(seed)
            noise = torch.randn((1, *prior.mean.shape), generator=generator)
            x = schedule.noise(chain[0]) * noise + schedule.signal(chain[0]) * prior.sample(1, generator)
            for step in SAMPLERS["ddim"](denoise, schedule, x, chain, [generator]):
                x = step.x0
            features = (prior.split(x)[0] / self.denoiser.component_std)[:, : self.shapes.weight.shape[1]]
            yield VoxelPerson(self.codec.decode(x.clone())[0], self.shapes.sample(features, [generator])[0])

    def primitives(self, grid: Float[Tensor, "64 64 64 4"]) -> Primitives:
        """Convert a grid to a primitive that the marcher can render."""
        return primitives_of(grid, self.full_density)


def dense_steps(length: int, steps: int) -> list[int]:
    """Descending t from T-1, denser at low noise: with evenly spaced steps all fine detail comes from the last one."""
    chain = [length - 1]
    for i in range(1, steps):
        wanted = round(length * (1 - i / steps) ** 2.2) - 1
        chain.append(min(max(wanted, steps - 1 - i), chain[-1] - 1))
    return chain


def voxel_denoiser(
    prior: PersonPrior, codec: VoxelCodec, config: VoxelUNetConfig = VoxelUNetConfig()
) -> PersonDenoiser:
    """Build an untrained denoiser: the default model's with a 3D U-Net for the cells."""
    denoiser = PersonDenoiser(None, prior, SCHEDULES[SCHEDULE]())
    denoiser.local = VoxelUNet(len(codec.basis), len(prior.parity), codec.cells, config)
    return denoiser.eval().requires_grad_(False)


def save_voxel_model(path: Path, model: VoxelModel) -> None:
    """Write the model, atomically."""
    tensors = {f"denoiser.{name}": value for name, value in model.denoiser.state_dict().items()}
    tensors |= {f"codec.{field.name}": getattr(model.codec, field.name) for field in dataclasses.fields(VoxelCodec)}
    tensors |= {f"shapes.{field.name}": getattr(model.shapes, field.name) for field in dataclasses.fields(ShapePrior)}
    about = {"full_density": model.full_density, "card": model.card}
    with atomic_path(path) as unfinished:
        contents = {name: value.detach().contiguous() for name, value in tensors.items()}
        unfinished.write_bytes(save(contents, metadata={"about": json.dumps(about)}))


def load_voxel_model(path: Path) -> VoxelModel:
    """Load what `save_voxel_model` wrote. Raises FileNotFoundError, and ValueError for an unreadable file."""
    if not path.is_file():
        raise FileNotFoundError(f"no voxel baseline at {path}: train one with benchmarks/train_baselines.py voxels")
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads(file.metadata()["about"])
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - safe_open is no mapping
        codec, shapes = VoxelCodec(**_under(tensors, "codec.")), ShapePrior(**_under(tensors, "shapes."))
        weights = _under(tensors, "denoiser.")
        denoiser = voxel_denoiser(PersonPrior(**_under(weights, "prior_")), codec)
        denoiser.load_state_dict(weights)
    except (SafetensorError, KeyError, TypeError, RuntimeError, OSError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"{path} is not a voxel baseline of this version ({reason}): train it again") from error
    return VoxelModel(denoiser, codec, shapes, about["full_density"], about["card"])


def _under(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
