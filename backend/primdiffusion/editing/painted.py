"""Painted regions on disk: an .npz with `weights`, a number for each vertex of human.npz's body."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.formats.arrays import read_arrays


def read_weights(path: str | Path) -> Float[Tensor, "v"]:
    """The painted weights in a file. Raises FileNotFoundError, and ValueError for a file that holds none."""
    weights = read_arrays(path, ("weights",))["weights"]
    if weights.dtype.kind not in "fiub" or weights.ndim != 1:
        raise ValueError(f"the weights in {path} are {weights.dtype} {weights.shape}: give one number for each vertex")
    return torch.from_numpy(weights.astype(np.float32))
