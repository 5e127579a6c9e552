"""Painted regions on disk: an .npz with `weights`, a number for each vertex of human.npz's body."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


def read_weights(path: str | Path) -> Float[Tensor, "v"]:
    """The painted weights in a file. Raises FileNotFoundError, and ValueError for a file that holds none."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there are no painted weights in {path}: check the path")
    try:
        with np.load(path, allow_pickle=False) as stored:
            weights = np.asarray(stored["weights"])
    except (ValueError, KeyError, TypeError, EOFError, OSError, zipfile.BadZipFile, zlib.error) as e:
        raise ValueError(f"{path} holds no painted weights ({e}): it needs an array named weights") from e
    if weights.dtype.kind not in "fiub" or weights.ndim != 1:
        raise ValueError(f"the weights in {path} are {weights.dtype} {weights.shape}: give one number for each vertex")
    return torch.from_numpy(weights.astype(np.float32))
