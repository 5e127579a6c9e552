"""Which exceptions are errors of input, files or memory, and how users read them: a sentence, a kind, a remedy.

Domain errors of this package subclass builtins, so builtin types decide; everything else is a defect of ours and keeps
its traceback. Imports no torch: the child answers `hello` before torch is there.
"""

from __future__ import annotations

import dataclasses
import re


@dataclasses.dataclass(frozen=True)
class Failure:
    """An error as a user reads it."""

    kind: str
    sentence: str
    remedy: str
    """What to do next; empty where the sentence, being ours, says it already."""

    def __str__(self) -> str:
        return f"{self.sentence}: {self.remedy}" if self.remedy else self.sentence


class PictureOutOfMemory(MemoryError):
    """A picture that this machine cannot hold."""

    def __init__(self, width: int, height: int):
        super().__init__(f"there is not enough memory for a picture of {width} x {height} pixels")


PICTURE_REMEDY = "choose a smaller resolution, or close other programs, then try again"
MEMORY_REMEDY = "close other programs, or choose a smaller checkpoint or picture, then try again"


def describe(error: BaseException) -> Failure | None:
    """The failure `error` stands for, or None where it is no domain error but a defect."""
    sentence = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, PictureOutOfMemory):
        return Failure("out_of_memory", sentence, PICTURE_REMEDY)
    if out_of_memory(error):
        amount = re.search(r"[Tt]ried to allocate ([\d.]+ \w+)", sentence, re.ASCII)
        wanted = f" when it asked for {amount[1]} more" if amount else ""
        where = "graphics card" if "CUDA" in sentence else "machine"
        return Failure("out_of_memory", f"the {where} ran out of memory{wanted}", MEMORY_REMEDY)
    if isinstance(error, ImportError):
        remedy = "install the backend's packages into the Python that runs it, or choose another Python"
        return Failure("environment", f"a package of the backend could not be loaded: {sentence}", remedy)
    if isinstance(error, PermissionError | NotADirectoryError | IsADirectoryError):
        return Failure("unwritable", _of_file(error), "choose a folder and files that you may read and write")
    if isinstance(error, FileNotFoundError):
        return Failure("missing_file", _of_file(error), "check the path" if error.strerror else "")
    if isinstance(error, OSError):
        return Failure("file_system", _of_file(error), "check the disk's free space and the path, then try again")
    if isinstance(error, ValueError):
        return Failure("bad_input", sentence, "")
    return None


def out_of_memory(error: BaseException) -> bool:
    """Whether `error` says that memory ran out.

    torch raises plain RuntimeError where its CPU allocator gives up, and its own subclass on a GPU.
    """
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    return isinstance(error, RuntimeError) and (
        "not enough memory" in str(error) or "can't allocate memory" in str(error)
    )


def _of_file(error: OSError) -> str:
    """Python's own OSErrors read "[Errno 13] Permission denied: 'x'"; ours are sentences already."""
    if error.strerror and error.filename:
        return f"{error.filename}: {error.strerror[0].lower()}{error.strerror[1:]}"
    return " ".join(str(error).split()) or type(error).__name__
