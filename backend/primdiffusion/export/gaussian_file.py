"""Write 3D Gaussians as PLY, in the layout that Gaussian splatting viewers and trainers share.

Binary little endian, float32, one vertex per Gaussian: x y z, nx ny nz (zero), f_dc_0..2, opacity, scale_0..2,
rot_0..3. `opacity` is a logit, `scale` the logarithm of standard deviations in metres, `rot` a quaternion w x y z. f_dc
is (colour - 0.5) / C0 with sRGB-encoded colour: viewers display 0.5 + C0 f_dc without a transfer function. There is no
f_rest: colours do not depend on the view. Axes are y up, facing +z; viewers that expect y down, as in scenes
reconstructed from photographs, show the human upside down by default.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from primdiffusion.export.gaussians import Gaussians
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.staging import written_whole

C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2 sqrt(pi))."""
PROPERTIES = (
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
    "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip


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
    with written_whole(path) as unfinished:
        unfinished.write_bytes(header.encode() + np.ascontiguousarray(rows).tobytes())
