"""The attacks, in rounds until a time is over; and their figures."""

from __future__ import annotations

import dataclasses
import itertools
import random
import time
from collections.abc import Callable, Collection
from pathlib import Path

from chaos.child_deaths import Deaths
from chaos.forks import Forks
from chaos.full_disk import can_mount, fill_and_repeat, limit_and_repeat
from chaos.kills import Tally, Undisturbed, kill_and_repeat, undisturbed
from chaos.programs import Inputs, Program, all_programs
from chaos.surroundings import broken_environment, entry_commands, odd_environments, try_broken, try_environments

Report = Callable[[str], None]
ATTACKS = ("environments", "disks", "deaths", "kills")
TRIES = 4
"""At the most, until a disk becomes full in the middle of a command."""
STOPS_EVERY = 25
"""Deaths of the child between two stops of it."""


@dataclasses.dataclass
class Outcome:
    """What all attacks did."""

    kills: Tally = dataclasses.field(default_factory=Tally)
    disks: Tally = dataclasses.field(default_factory=Tally)
    children: Tally = dataclasses.field(default_factory=Tally)
    environments: Tally = dataclasses.field(default_factory=Tally)
    child_hangs: int = 0
    filled: set[str] = dataclasses.field(default_factory=set)
    """Commands whose disk became full."""

    @property
    def wrong(self) -> list[str]:
        """A sentence for each fault."""
        return [what for tally in (self.kills, self.disks, self.children, self.environments) for what in tally.wrong]

    def figures(self, attacks: Collection[str]) -> dict[str, int]:
        """Of these attacks, as docs/results/faults.json names them."""
        figures = {
            "environments": {"environments": self.environments.count, "environments_failed": self.environments.lost},
            "disks": {"disk_full_commands": len(self.filled), "disk_full_losses": self.disks.lost},
            "deaths": {
                "child_deaths": self.children.count,
                "child_deaths_lost": self.children.lost,
                "child_hangs": self.child_hangs,
            },
            "kills": {"kills": self.kills.count, "kills_lost": self.kills.lost},
        }
        return {name: value for attack in attacks for name, value in figures[attack].items()}


class Attack:
    """Attacks on programs whose own results are made once."""

    def __init__(self, folder: Path, forks: Forks, seed: int, names: Collection[str] = ()) -> None:
        """`names` of the programs; all if there are none. Raises ValueError for a name that no program has."""
        self._folder, self._forks, self.rng = folder, forks, random.Random(seed)
        self.inputs = Inputs(folder)
        known = {one.name: one for one in all_programs(self.inputs)}
        if unknown := [name for name in names if name not in known]:
            raise ValueError(f"there is no program {unknown[0]!r} here: choose from {', '.join(known)}")
        self.programs = [known[name] for name in names or known]
        self._known: dict[str, Undisturbed] = {}
        self.outcome = Outcome()
        self.mounts = can_mount(folder / "try")

    def kill(self, program: Program) -> None:
        """One to three deaths of a program in the same folder, and a run to its end."""
        kill_and_repeat(self._undisturbed(program), self._forks, self.rng, self._folder / "killed", self.outcome.kills)

    def fill(self, program: Program) -> None:
        """A full disk, in the middle of the program's files."""
        attack = fill_and_repeat if self.mounts else limit_and_repeat
        for _ in range(TRIES):
            whole = self._undisturbed(program)
            if attack(whole, self._forks, self.rng, self._folder / "disk", self.outcome.disks):
                self.outcome.filled.add(program.name)
                return

    def children(self, count: int) -> None:
        """So many deaths of the child, and stops between them."""
        folder = self._folder / f"children{self.rng.getrandbits(32):08x}"
        folder.mkdir()
        deaths = Deaths(folder, self.rng)
        deaths.tally = self.outcome.children
        end = self.outcome.children.count + count
        others = (deaths.stopped, deaths.killed_between_requests, deaths.stopped_and_cancelled, deaths.works,
                  deaths.stopped_and_continued)  # fmt: skip
        while self.outcome.children.count < end:
            for _ in range(min(STOPS_EVERY, max(count // 2, 1))):
                deaths.killed()
            for other in others:
                other()
        deaths.end()
        self.outcome.child_hangs += deaths.hangs

    def environments(self, names: Collection[str] = ()) -> None:
        """Odd environments of the entry commands, or of those of these names."""
        tally, out = self.outcome.environments, self._folder / "entered"
        commands = entry_commands(self.inputs.checkpoint, self.inputs.human(1), out)
        chosen = {name: command for name, command in commands.items() if not names or name in names}
        try_environments(chosen, odd_environments(self._folder), tally)
        try_broken(chosen, broken_environment(self._folder), tally)

    def everything(self, attacks: Collection[str], kills: int, minutes: float, deaths: int, report: Report) -> None:
        """The chosen of ATTACKS, in their order.

        Programs are killed in turn, each once at least: until there are so many `kills`, or without a number, until the
        minutes are over.
        """
        end = time.monotonic() + 60 * minutes
        if "environments" in attacks:
            report("environments")
            self.environments()
        if "disks" in attacks:
            for program in self.programs:
                report(f"a full disk: {program.name}")
                self.fill(program)
        if "deaths" in attacks:
            report(f"{deaths} deaths of the child")
            self.children(deaths)
        if "kills" in attacks:
            self._kill_in_turn(lambda: self.outcome.kills.count >= kills if kills else time.monotonic() > end, report)

    def _kill_in_turn(self, is_over: Callable[[], bool], report: Report) -> None:
        for turn, program in enumerate(itertools.cycle(self.programs)):
            if turn >= len(self.programs) and is_over():
                return
            report(f"kills: {program.name} ({self.outcome.kills.count} so far)")
            self.kill(program)

    def _undisturbed(self, program: Program) -> Undisturbed:
        if program.name not in self._known:
            folder = self._folder / f"whole {program.name}"
            self._known[program.name] = undisturbed(program, self._forks, folder)
        return self._known[program.name]
