"""Inputs that are kept: those that reach new lines, from which others are made, and those that have found something."""

from __future__ import annotations

import hashlib
import lzma
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from numpy.random import Generator

from fuzz.mutations import pick

CASES = Path(__file__).with_name("cases")
"""Inputs that have found something: a folder for each target. `test_cases` reads them again."""
ROOM = 64 * 2**20
"""Bytes of inputs that are kept in memory for each target."""
_PACKED_FROM = 20_000
"""Larger files are packed: humans are long and repetitive."""


def folder_of(target: str) -> str:
    """The name of the folder with a target's inputs."""
    return "".join(letter if letter.isalnum() else "_" for letter in target)


def kept(folder: Path) -> Iterator[tuple[Path, bytes]]:
    """The inputs in a folder, if there is one."""
    for path in sorted(folder.glob("*")):
        content = path.read_bytes()
        yield path, lzma.decompress(content) if path.suffix == ".xz" else content


def keep(folder: Path, content: bytes, suffix: str) -> Path:
    """Write an input into a folder, named by its hash."""
    path = folder / (hashlib.sha256(content).hexdigest()[:12] + suffix)
    if len(content) >= _PACKED_FROM:
        path, content = path.with_name(f"{path.name}.xz"), lzma.compress(content)
    folder.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


class Corpus:
    """The inputs of a target that have reached something new, the valid one first."""

    def __init__(self, valid: bytes, folder: Path | None = None) -> None:
        """With a `folder`, inputs are kept there for the next run, too."""
        self.contents, self._folder, self._room = [valid], folder, ROOM
        self._waiting = [] if folder is None else list(kept(folder))

    def waiting(self) -> bytes | None:
        """An input of an earlier run that has yet to be read; it is forgotten unless it is learned again."""
        if not self._waiting:
            return None
        path, content = self._waiting.pop()
        path.unlink(missing_ok=True)
        return content

    def chosen(self, rng: Generator) -> bytes:
        """An input to be damaged."""
        return self.contents[0] if rng.random() < 0.2 else pick(rng, self.contents)

    def learn(self, content: bytes) -> None:
        """Keep an input as long as there is room."""
        if len(content) <= self._room:
            self._room -= len(content)
            self.contents.append(content)
            if self._folder is not None:
                keep(self._folder, content, "")


def shrunk(content: bytes, is_same: Callable[[bytes], bool], seconds: float = 5.0) -> bytes:
    """The content without pieces that a finding does not need, as far as `seconds` of work allow."""
    size, end = len(content) // 2, time.process_time() + seconds
    while size and time.process_time() < end:
        for begin in range(0, len(content), size):
            shorter = content[:begin] + content[begin + size :]
            if time.process_time() < end and is_same(shorter):
                content = shorter
                break
        else:
            size //= 2
    return content
