"""A human as 3D Gaussians (Kerbl et al. 2023), one for each visible voxel; and their PLY file.

The file has the layout that viewers and trainers share: binary little endian, float32, one vertex per Gaussian: x y z,
nx ny nz (zero), f_dc_0..2, opacity, scale_0..2, rot_0..3. `opacity` is a logit, `scale` the logarithm of standard
deviations in metres, `rot` a quaternion w x y z. f_dc is (colour - 0.5) / C0 with sRGB-encoded colour: viewers display
0.5 + C0 f_dc without a transfer function. There is no f_rest: colours do not depend on the view. Axes are y up, facing
+z; viewers that expect y down, as in scenes reconstructed from photographs, show the human upside down by default.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from primdiffusion.export.surface import depth_below
from primdiffusion.files.whole_files import atomic_path
from primdiffusion.formats.requests import GaussiansRequest
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import WINDOW_POWER, WINDOW_SHARPNESS, Primitives
from primdiffusion.render.merge import merge

WIDTH = 1 / 6**0.5
"""Standard deviation of a voxel's trilinear kernel, in voxel spacings: the Gaussian has the kernel's own variance."""
GAIN = 1.2
"""Optical depth of a Gaussian relative to its voxel's opacity. Gaussians composite as 1 - product(1 - a), while the
marcher adds opacities until 1 and so occludes sooner."""
DEEPEST = 0.025
"""Depth below the surface beyond which voxels are dropped as invisible, metres."""
DEPTH_VOXEL = 0.008
"""Voxel of the grid in which depth is measured, metres."""
FAINTEST = 1 / 255
"""Opacity below which viewers skip a Gaussian."""
C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi))."""
PROPERTIES = (
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
    "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Gaussians(TensorRecord):
    """3D Gaussians in world space."""

    position: Float[Tensor, "n 3"]
    """Metres."""
    rotation: Float[Tensor, "n 4"]
    """Unit quaternions w, x, y, z, local to world."""
    scale: Float[Tensor, "n 3"]
    """Standard deviations along the local axes, metres."""
    opacity: Float[Tensor, "n"]
    """Along a ray through the centre, in (0, 1)."""
    rgb: Float[Tensor, "n 3"]
    """Linear, in [0, 1]."""


def gaussians_of(primitives: Primitives, limit: int = GaussiansRequest.limit) -> Gaussians:
    """Convert the voxels of an unbatched set of boxes to at most `limit` Gaussians, the most opaque of each box.

    A voxel's opacity is that along the box's normal; voxels deeper than DEEPEST are left out. Raises ValueError for a
    limit below one and if no voxel is visible.
    """
    if limit < 1:
        raise ValueError(f"the limit is {limit} Gaussians: choose 1 or more")
    size = primitives.density.shape[-1]
    share, centre = (moment.to(primitives.position) for moment in _kernel(size))
    window = share[:, None, None] * share[:, None] * share
    spacing = primitives.half_extent * 2 / (size - 1)
    depth = GAIN * primitives.density * window * spacing[:, 2, None, None, None]
    opacity = 1 - torch.exp(-depth)
    box, d, h, w = (opacity >= FAINTEST).nonzero(as_tuple=True)
    local = torch.stack([centre[w], centre[h], centre[d]], -1) * primitives.half_extent[box]
    position = primitives.position[box] + (primitives.rotation[box] @ local[..., None])[..., 0]
    grid = merge(primitives, DEPTH_VOXEL, points=1)
    seen = torch.from_numpy(depth_below(grid, position.double().cpu().numpy()) <= DEEPEST)
    kept = opacity[box, d, h, w].clamp_max(0.995)
    chosen = seen.to(kept.device).nonzero()[:, 0]
    if len(chosen) > limit:
        chosen = chosen[_rank_in_box(box[chosen], kept[chosen]).argsort(stable=True)[:limit]]
    if not len(chosen):
        raise ValueError("no voxel of this human is dense enough to be visible: generate it again")
    box, d, h, w = (index[chosen] for index in (box, d, h, w))
    return Gaussians(
        position=position[chosen],
        rotation=_quaternions(primitives.rotation)[box],
        scale=spacing[box] * WIDTH,
        opacity=kept[chosen],
        rgb=primitives.rgb.movedim(1, -1)[box, d, h, w].clamp(0, 1),
    )


def _rank_in_box(box: Int[Tensor, "n"], opacity: Float[Tensor, "n"]) -> Int[Tensor, "n"]:
    """Rank by opacity within each box, so that a limit thins all parts of the body evenly."""
    falling = opacity.argsort(descending=True, stable=True)
    order = falling[box[falling].argsort(stable=True)]
    count = torch.bincount(box)
    rank = torch.empty_like(box)
    rank[order] = torch.arange(len(box), device=box.device) - (count.cumsum(0) - count)[box[order]]
    return rank


def _kernel(size: int) -> tuple[Float[Tensor, "s"], Float[Tensor, "s"]]:
    """Mass and centroid of each voxel's linear kernel times the window, along one axis."""
    place = torch.linspace(-1, 1, 4001, dtype=torch.float64)
    spacing = 2 / (size - 1)
    voxel = torch.linspace(-1, 1, size, dtype=torch.float64)[:, None]
    left = (1 - (place - voxel).abs() / spacing).clamp_min(0) * torch.exp(-WINDOW_SHARPNESS * place.pow(WINDOW_POWER))
    mass = left.sum(1)
    return mass * (2 / 4000) / spacing, (left * place).sum(1) / mass


def _quaternions(rotation: Float[Tensor, "k 3 3"]) -> Float[Tensor, "k 4"]:
    """Convert rotation matrices to quaternions w, x, y, z."""
    turned = Rotation.from_matrix(rotation.detach().cpu().double().numpy()).as_quat()[:, [3, 0, 1, 2]]
    return torch.from_numpy(turned).to(rotation)


def write_gaussians(path: str | Path, gaussians: Gaussians) -> None:
    """Write the file, atomically. Raises OSError."""
    columns = [
        gaussians.position,
        torch.zeros_like(gaussians.position),
        (encode_srgb(gaussians.rgb) - 0.5) / C0,
        torch.logit(gaussians.opacity)[:, None],
        gaussians.scale.log(),
        gaussians.rotation,
    ]
    rows = torch.cat(columns, -1).detach().cpu().numpy().astype("<f4")
    names = "".join(f"property float {name}\n" for name in PROPERTIES)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{names}end_header\n"
    with atomic_path(path) as unfinished:
        unfinished.write_bytes(header.encode() + np.ascontiguousarray(rows).tobytes())
