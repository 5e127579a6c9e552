"""Describe errors of input, files and memory to users: a sentence, a kind and a remedy.

Domain errors of this package subclass builtins, so builtin types decide; any other error is a bug and is shown with its
traceback. Imports no torch, because the child answers `hello` before torch is loaded.
"""

from __future__ import annotations

import dataclasses
import importlib
import re
import traceback
from types import ModuleType

from primdiffusion.files.regular_files import printable


@dataclasses.dataclass(frozen=True)
class ErrorDescription:
    """An error as shown to users."""

    kind: str
    sentence: str
    remedy: str
    """Next step; empty if the sentence says so already."""

    def __str__(self) -> str:
        return f"{self.sentence}: {self.remedy}" if self.remedy else self.sentence


class PictureOutOfMemory(MemoryError):
    """An image that does not fit into memory."""

    def __init__(self, width: int, height: int):
        super().__init__(width, height)  # by which it is pickled

    def __str__(self) -> str:
        return "there is not enough memory for a picture of {} x {} pixels".format(*self.args)


class MissingPackageError(ImportError):
    """An optional package that is not installed; the message says what to do."""


def optional_package(module: str, extra: str = "", missing: str = "") -> ModuleType:
    """Import a module of an optional package, which `extra` of pyproject.toml installs, or else `missing` explains.

    Raises MissingPackageError if it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module.partition(".")[0]:
            raise
        extras = f'this needs {error.name}, which is not installed: run pip install "primdiffusion[{extra}]"'
        raise MissingPackageError(missing or extras) from error


_LONGEST_NAME, _LONGEST_VALUE = 200, 80
"""Characters of a path, and of a quoted text or list, in a sentence."""
_VALUE = re.compile(r"(?<!\w)'[^'/\\]*'|\[[^\[\]/\\]*\]")
"""A quoted text or a list that is not a path."""
PICTURE_REMEDY = "choose a smaller resolution, or close other programs, then try again"
MEMORY_REMEDY = "close other programs, or choose a smaller checkpoint or picture, then try again"


def to_user_error(error: BaseException) -> ErrorDescription | None:
    """Return the description of a domain error, or None for a bug. It holds no terminal escapes of a file."""
    found = _described(error)
    return None if found is None else dataclasses.replace(found, sentence=printable(found.sentence))


def traceback_of(error: BaseException) -> str:
    """Return the traceback of an error, whose message may quote a file, as lines for a terminal."""
    return "".join(f"{printable(line)}\n" for line in "".join(traceback.format_exception(error)).splitlines())


def _described(error: BaseException) -> ErrorDescription | None:
    sentence = shorten(" ".join(str(error).split())) or type(error).__name__
    if isinstance(error, PictureOutOfMemory):
        return ErrorDescription("out_of_memory", sentence, PICTURE_REMEDY)
    if out_of_memory(error):
        amount = re.search(r"[Tt]ried to allocate ([\d.]+ \w+)", sentence, re.ASCII)
        wanted = f" when it asked for {amount[1]} more" if amount else ""
        where = "graphics card" if "CUDA" in sentence or "MPS" in sentence else "machine"
        return ErrorDescription("out_of_memory", f"the {where} ran out of memory{wanted}", MEMORY_REMEDY)
    if isinstance(error, MissingPackageError):
        return ErrorDescription("environment", sentence, "")
    if isinstance(error, ImportError):
        remedy = "install the backend's packages into the Python that runs it, or choose another Python"
        return ErrorDescription("environment", f"a package of the backend could not be loaded: {sentence}", remedy)
    if isinstance(error, PermissionError | NotADirectoryError | IsADirectoryError):
        return ErrorDescription("unwritable", _of_file(error), "choose a folder and files that you may read and write")
    if isinstance(error, FileNotFoundError):
        return ErrorDescription("missing_file", _of_file(error), "check the path" if error.strerror else "")
    if isinstance(error, OSError):
        return ErrorDescription(
            "file_system", _of_file(error), "check the disk's free space and the path, then try again"
        )
    if isinstance(error, ValueError):
        return ErrorDescription("bad_input", sentence, "")
    return None


def shorten(sentence: str) -> str:
    """Return a sentence whose quoted texts and lists, which may be of a hostile file, are cut to a readable length."""

    def cut(value: re.Match[str]) -> str:
        text = value[0]
        return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 4]}...{text[-1]}"

    return _VALUE.sub(cut, sentence)


def out_of_memory(error: BaseException) -> bool:
    """Return whether memory ran out: torch raises RuntimeError for the CPU's and a subclass of it for a GPU's."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    return isinstance(error, RuntimeError) and (
        "not enough memory" in str(error)
        or "can't allocate memory" in str(error)
        or "MPS backend out of memory" in str(error)
    )


def _of_file(error: OSError) -> str:
    """Rewrite Python's "[Errno 13] Permission denied: 'x'"; messages of this package are sentences already."""
    if error.strerror and error.filename:
        name = str(error.filename)
        name = name if len(name) <= _LONGEST_NAME else f"{name[:60]}...{name[60 - _LONGEST_NAME :]}"
        return f"{name}: {error.strerror[0].lower()}{error.strerror[1:]}"
    return " ".join(str(error).split()) or type(error).__name__
