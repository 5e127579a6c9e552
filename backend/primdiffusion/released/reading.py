"""Reading a torch file of weights without running anything in it."""

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
"""Top-level key under which the released code saves its weights; "optimizer" is beside it."""
PICKLE_ERRORS = (
    pickle.UnpicklingError, RuntimeError, EOFError, ValueError, TypeError, LookupError, AttributeError, OverflowError,
    MemoryError, NotImplementedError, AssertionError, OSError, struct.error,
)  # fmt: skip
"""What torch raises for bytes that are no torch file; the restricted unpickler has no type of its own."""
_ZIP_MAGIC = b"PK\x03\x04"


class ReleasedFileError(ValueError):
    """A file that is no checkpoint of the released code; the message names it, what is wrong and what to do."""


def read_weights(path: Path) -> dict[str, Tensor]:
    """The tensors of a released checkpoint in the file's order; mapped where the file allows: optimisers cost nothing.

    Raises:
        FileNotFoundError: there is no such file.
        ReleasedFileError: it asks for code to be run, is truncated, or holds no dictionary of named tensors.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no checkpoint at {path}: give the path of the authors' primdiffusion.pt")
    content = _load(path)
    state = content.get(STATE, content) if isinstance(content, Mapping) else content
    if not isinstance(state, Mapping):
        raise ReleasedFileError(
            f"{path} holds a {type(state).__name__} where {STATE!r} belongs: give the authors' primdiffusion.pt"
        )
    for key, value in state.items():
        if not isinstance(key, str) or not isinstance(value, Tensor) or value.layout != torch.strided:
            raise ReleasedFileError(
                f"{path}: {key!r} is a {type(value).__name__}, not an ordinary tensor: give the authors' "
                f"primdiffusion.pt, whose top-level keys are {STATE!r}, a dictionary of tensors, and 'optimizer'"
            )
    return dict(state)


def _load(path: Path) -> object:
    with open(path, "rb") as file:
        mappable = file.read(len(_ZIP_MAGIC)) == _ZIP_MAGIC
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of torch, about pickles that are then refused
            return torch.load(path, map_location="cpu", weights_only=True, mmap=mappable)
    except PICKLE_ERRORS as error:
        asked = re.search(r"GLOBAL:? (\S+)|global (\S+)", str(error))
        if asked:
            raise ReleasedFileError(
                f"{path} asks for {asked[1] or asked[2]} to be run when it is opened, which weights never need; "
                "nothing in it was run: take the file from its publisher again"
            ) from error
        raise ReleasedFileError(
            f"{path} is truncated or no torch file ({_first_sentence(error)}): take it from its publisher again"
        ) from error


def _first_sentence(error: BaseException) -> str:
    return re.split(r"\.\s|\n", str(error).strip(), maxsplit=1)[0][:120] or type(error).__name__
