"""Inputs that have found something, which are kept."""

from __future__ import annotations

import hashlib
import lzma
import time
from collections.abc import Callable, Iterator
from pathlib import Path

CASES = Path(__file__).with_name("cases")
"""A folder for each target. `test_findings` reads them again."""
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
