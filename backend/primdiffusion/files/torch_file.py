"""Read files of torch.save: torch's restricted unpickler, which runs no code from them, under a limit of memory."""

from __future__ import annotations

import io
import pickle
import warnings
import zipfile
from pathlib import Path

import torch
from torch import Tensor

from primdiffusion.files.regular_files import FileError, open_regular
from primdiffusion.files.tensor_file import LARGEST_FILE

LARGEST_PICKLE = 8 * 2**20
"""Largest pickle in an archive, bytes; its numbers are not in it. A state dict needs some 100 bytes a tensor."""
_ZIP_MAGIC = b"PK\x03\x04"
_ENDLESS = b"bytearray\n"
"""A global that torch's unpickler calls with any size that a pickle states; weights never need it."""


def load(path: Path) -> object:
    """Return what torch.save wrote. Numbers of files since torch 1.6 stay on disk until they are used.

    Raises FileError for a damaged file, and one that asks for more than tensors and plain values; OSError.
    """
    with open_regular(path, LARGEST_FILE) as file:
        archive = file.read(len(_ZIP_MAGIC)) == _ZIP_MAGIC
        file.seek(0)
        try:
            # before torch 1.6, names stand before numbers
            _check_archive(file, path) if archive else _check_globals(file.read(LARGEST_PICKLE))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # torch warns about pickles that it then rejects
                # mapped: torch does not compare the sizes that an archive states with those of its storages
                return torch.load(path, map_location="cpu", weights_only=True, mmap=archive)
        except FileError:
            raise
        except Exception as error:  # torch has no class of its own for what damaged files raise
            raise FileError(path, *_fault(error)) from error


def is_plain(value: Tensor) -> bool:
    """Whether a tensor is one of numbers in memory: not sparse, nested, quantised or without content."""
    return value.layout == torch.strided and not (value.is_nested or value.is_quantized or value.is_meta)


def _check_archive(file: io.BufferedReader | io.BytesIO, path: Path) -> None:
    with zipfile.ZipFile(file) as archive:
        for member in archive.infolist():
            if member.compress_type != zipfile.ZIP_STORED:
                raise FileError(path, "is compressed, which torch.save never does", "save it again")
            if member.filename.endswith(".pkl"):
                if member.file_size > LARGEST_PICKLE:
                    raise FileError(path, f"holds {member.file_size} bytes of names", "save the weights alone")
                _check_globals(archive.read(member))


def _check_globals(content: bytes) -> None:
    if _ENDLESS in content:
        raise pickle.UnpicklingError("Unsupported global: GLOBAL builtins.bytearray")


def _fault(error: Exception) -> tuple[str, str]:
    """Reason and remedy. torch puts advice to unpickle all the same before the sentence that it had caught."""
    cause = error.__context__ if isinstance(error, pickle.UnpicklingError) and error.__context__ else error
    sentence = next(iter(str(cause).split(". ")[0].splitlines()), type(cause).__name__)
    if "GLOBAL " in sentence:
        asked = sentence.partition("GLOBAL ")[2].split(" ")[0]
        return (
            f"would execute {asked:.80} when loaded, which weights never need; nothing was executed",
            "download it again from its publisher",
        )
    return (
        f"is truncated or not a torch file ({sentence:.120})",
        "download it again, or save the network's state_dict()",
    )
