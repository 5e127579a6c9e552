"""Read painted regions: an .npz with `weights`, one number for each vertex of the body in human.npz."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.formats.arrays import read_arrays


def read_weights(path: str | Path) -> Float[Tensor, "v"]:
    """Read painted weights. Raises FileNotFoundError, and ValueError for a file without usable weights."""
    weights = read_arrays(path, ("weights",))["weights"]
    if weights.dtype.kind not in "fiub" or weights.ndim != 1:
        raise ValueError(f"weights in {path} are {weights.dtype} {weights.shape}: give one number for each vertex")
    return torch.from_numpy(weights.astype(np.float32))
