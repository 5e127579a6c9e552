"""Kills: a command line that dies at a random moment and is given again loses nothing."""

from __future__ import annotations

import dataclasses
import random
import shutil
from pathlib import Path

from chaos.forks import Ended, Forks, random_death
from chaos.programs import Program
from chaos.results import differences, files_of, finished, half_written, set_back

MOST_IN_A_ROW = 3


@dataclasses.dataclass
class Tally:
    """Counts, and a sentence for everything that went wrong."""

    count: int = 0
    wrong: list[str] = dataclasses.field(default_factory=list)
    lost: int = 0
    """Of `count`."""

    def add(self, count: int, wrong: list[str], where: str) -> None:
        """Count attempts, and a loss if anything was wrong."""
        self.count += count
        self.lost += bool(wrong)
        self.wrong += [f"{where}: {what}" for what in wrong]


@dataclasses.dataclass(frozen=True)
class Undisturbed:
    """A program's own result."""

    program: Program
    folder: Path
    run: Ended

    @property
    def largest(self) -> int:
        """Bytes of the largest file."""
        return max(path.stat().st_size for path in files_of(self.folder).values())


def undisturbed(program: Program, forks: Forks, folder: Path) -> Undisturbed:
    """Run a program to its end in a new folder. Raises AssertionError if it fails."""
    program.prepare(folder)
    run = program.run(forks, folder)
    assert run.exit_code == 0, f"{program.name}: {run.log}"
    return Undisturbed(program, folder, run)


def kill_and_repeat(whole: Undisturbed, forks: Forks, rng: random.Random, out: Path, tally: Tally) -> None:
    """Let a program die up to MOST_IN_A_ROW times in a folder, then run it to its end and compare.

    Nothing may be half-written after a death, nor may what was finished before it be gone.
    """
    program, deaths, wrong = whole.program, [], []
    program.prepare(out)
    before = finished(out, whole.folder)
    for number in range(rng.randint(1, MOST_IN_A_ROW)):
        death = random_death(rng, whole.run, whole.largest, 1 / (1 + number if program.resumes else 1))
        ended = program.run(forks, out, death)
        if ended.exit_code >= 0:
            if ended.exit_code and differences(out, whole.folder):
                wrong.append(f"after {len(deaths)} deaths it failed: {ended.log[-300:]}")
            break
        deaths.append(death)
        wrong += [f"{name} was published half-written" for name in half_written(out)]
        now = finished(out, whole.folder)
        wrong += set_back(before, now)
        before = now
    if not differences(out, whole.folder):  # it died after its last write
        tally.add(len(deaths), wrong, program.name)
        shutil.rmtree(out)
        return
    ended = program.run(forks, out)
    different = differences(out, whole.folder)
    if ended.exit_code and different:  # otherwise it has refused to replace what was finished
        wrong.append(f"it did not go on: {ended.log[-300:]}")
    wrong += different
    tally.add(len(deaths), wrong, f"{program.name}, {deaths}")
    shutil.rmtree(out)
