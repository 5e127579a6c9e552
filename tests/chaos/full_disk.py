"""Full disks: every command that writes ends with one sentence and exit code 1, and leaves nothing half-written."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

from chaos.forks import Ended, Forks
from chaos.kills import Tally, Undisturbed
from chaos.results import differences, files_of, half_written, leftovers, size_of

PAGE = 4096
ROOMY = 1 << 30
LONGEST_SENTENCE = 300


class Disk:
    """A small file system in memory, mounted on a folder; for root alone."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def resize(self, size: int) -> None:
        """Change its size in bytes."""
        _mount("-o", f"remount,size={max(size, PAGE)}", self.folder)


def can_mount(folder: Path) -> bool:
    """Whether file systems can be mounted here: by root, on Linux, outside most containers."""
    try:
        with mounted(folder):
            return True
    except (OSError, subprocess.CalledProcessError):
        return False


@contextlib.contextmanager
def mounted(folder: Path) -> Iterator[Disk]:
    """A `Disk` of ROOMY bytes. Raises OSError or CalledProcessError where it cannot be mounted."""
    folder.mkdir()
    try:
        _mount("-t", "tmpfs", "-o", f"size={ROOMY}", "none", folder)
        try:
            yield Disk(folder)
        finally:
            subprocess.run(["umount", str(folder)], check=True)
    finally:
        folder.rmdir()


def fill_and_repeat(whole: Undisturbed, forks: Forks, rng: random.Random, folder: Path, tally: Tally) -> bool:
    """Run a program on a disk that becomes full at a random point; then with room, and compare.

    Returns whether the disk became full.
    """
    with mounted(folder) as disk:
        out = disk.folder / "out"
        whole.program.prepare(out)
        given = set(files_of(out))
        disk.resize(_used(disk.folder) + int(rng.uniform(0, 1) * (size_of(whole.folder) + PAGE)))
        ended = whole.program.run(forks, out)
        if ended.exit_code == 0:
            return False
        wrong = complaints(ended)
        wrong += _left_behind(whole, out, given)
        disk.resize(ROOMY)
        wrong += _repeat(whole, forks, out)
    tally.add(1, wrong, whole.program.name)
    return True


def limit_and_repeat(whole: Undisturbed, forks: Forks, rng: random.Random, out: Path, tally: Tally) -> bool:
    """As `fill_and_repeat` for users who cannot mount: files above a random size cannot be written."""
    whole.program.prepare(out)
    given = set(files_of(out))
    limit = int(rng.uniform(0, 1) * whole.largest)
    ended = whole.program.run(forks, out, file_limit=limit)
    if ended.exit_code:
        tally.add(
            1, complaints(ended) + _left_behind(whole, out, given) + _repeat(whole, forks, out), whole.program.name
        )
    shutil.rmtree(out)
    return ended.exit_code != 0


def complaints(ended: Ended) -> list[str]:
    """What is wrong with the way in which a command fails."""
    wrong = []
    if ended.exit_code != 1:
        wrong.append(f"its exit code is {ended.exit_code}")
    sentences = [line for line in ended.log.splitlines() if line.startswith("primdiffusion: ")]
    if len(sentences) != 1 or "Traceback" in ended.log or len(sentences[0]) > LONGEST_SENTENCE:
        wrong.append(f"it does not end in one sentence: {ended.log[-600:]!r}")
    return wrong


def _left_behind(whole: Undisturbed, out: Path, given: set[str]) -> list[str]:
    wrong = [f"{name} was published half-written" for name in half_written(out)]
    wrong += [f"{name} was left over" for name in leftovers(out)]
    if not whole.program.resumes:
        wrong += [f"{name} was published alone" for name in set(files_of(out)) - given if name not in wrong]
    return wrong


def _repeat(whole: Undisturbed, forks: Forks, out: Path) -> list[str]:
    ended = whole.program.run(forks, out)
    if ended.exit_code:
        return [f"with room it fails, too: {ended.log[-300:]}"]
    return differences(out, whole.folder)


def _used(folder: Path) -> int:
    found = os.statvfs(folder)
    return (found.f_blocks - found.f_bfree) * found.f_frsize


def _mount(*words: str | Path) -> None:
    subprocess.run(["mount", *map(str, words)], check=True, capture_output=True)
