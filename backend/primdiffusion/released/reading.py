"""Read a torch checkpoint without executing pickled code."""

from __future__ import annotations

import pickle
import re
import struct
import warnings
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

STATE = "model_state_dict"
"""Top-level key of the weights in released checkpoints; the other is "optimizer"."""
PICKLE_ERRORS = (
    pickle.UnpicklingError, RuntimeError, EOFError, ValueError, TypeError, LookupError, AttributeError, OverflowError,
    MemoryError, NotImplementedError, AssertionError, OSError, struct.error,
)  # fmt: skip
"""Exceptions that torch raises for invalid files; its restricted unpickler has no exception class of its own."""
_ZIP_MAGIC = b"PK\x03\x04"


class ReleasedFileError(ValueError):
    """A file that is not a checkpoint of the released code."""


def read_weights(path: Path) -> dict[str, Tensor]:
    """Read the tensors of a released checkpoint in file order, memory-mapped if possible, so optimisers are not loaded.

    Raises:
        FileNotFoundError: the file does not exist.
        ReleasedFileError: the file would execute code, is truncated, or is not a dictionary of named tensors.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no checkpoint at {path}: give the path of the authors' primdiffusion.pt")
    content = _load(path)
    state = content.get(STATE, content) if isinstance(content, Mapping) else content
    if not isinstance(state, Mapping):
        raise ReleasedFileError(
            f"{path} contains a {type(state).__name__} instead of {STATE!r}: give the authors' primdiffusion.pt"
        )
    for key, value in state.items():
        if not isinstance(key, str) or not isinstance(value, Tensor) or value.layout != torch.strided:
            raise ReleasedFileError(
                f"{key!r} in {path} is a {type(value).__name__}, not a dense tensor: give the authors' "
                f"primdiffusion.pt, with top-level keys {STATE!r} and 'optimizer'"
            )
    return dict(state)


def _load(path: Path) -> object:
    with open(path, "rb") as file:
        mappable = file.read(len(_ZIP_MAGIC)) == _ZIP_MAGIC
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch warns about pickles that it then rejects
            return torch.load(path, map_location="cpu", weights_only=True, mmap=mappable)
    except PICKLE_ERRORS as error:
        asked = re.search(r"GLOBAL:? (\S+)|global (\S+)", str(error))
        if asked:
            raise ReleasedFileError(
                f"{path} would execute {asked[1] or asked[2]} when loaded, which weights never need; nothing was "
                "executed: download the file again from its publisher"
            ) from error
        raise ReleasedFileError(
            f"{path} is truncated or not a torch file ({_first_sentence(error)}): download it again"
        ) from error


def _first_sentence(error: BaseException) -> str:
    return re.split(r"\.\s|\n", str(error).strip(), maxsplit=1)[0][:120] or type(error).__name__
