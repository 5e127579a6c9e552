"""Command lines within Blender: options of records, a separate stdout, durations as text, Ctrl-C, reports."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import os
import signal
import sys
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NoReturn

from .files.regular_files import printable
from .files.whole_files import write_atomically
from .formats.schema import descriptions, field_types, split

DONE, FAILED, UNUSABLE, CANCELLED = 0, 1, 2, 130
"""Exit codes: all done; some failed, and the report lists them; usage error; stopped."""


class Stopped(Exception):
    """The command was asked to stop."""


class CommandParser(argparse.ArgumentParser):
    """A parser of command lines that raises ValueError, with options for fields of records."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(message)

    def add_declared(self, record: type, field: str, option: str = "", **changes: Any) -> None:
        """An option for a field: a flag, a choice, a file or a number, with its default and description."""
        kind, _ = split(field_types(record)[field])
        default = next(each.default for each in dataclasses.fields(record) if each.name == field)
        settings: dict[str, Any] = {"help": descriptions(record)[field].rstrip(".").replace("%", "%%")}
        if kind is bool:
            settings["action"] = "store_true"
        elif default is None:
            settings["type"] = Path
        else:
            choices = typing.get_args(kind) if typing.get_origin(kind) is Literal else None
            settings |= {"type": type(default), "choices": choices, "default": default}
            words = default if isinstance(default, tuple) else (default,)
            settings["help"] += f" (default {' '.join(map(str, words))})"
        self.add_argument(option or f"--{field.replace('_', '-')}", dest=field, **settings | changes)


def duration(seconds: float) -> str:
    """Seconds as text: 2 min 5 s."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {seconds} s" if minutes else f"{seconds} s"


@contextlib.contextmanager
def separate_stdout() -> Iterator[Callable[[str], None]]:
    """A function that writes lines to stdout, while Blender's own output is dropped."""
    sys.stdout.flush()
    ours = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)

    def say(line: str) -> None:
        os.write(ours, f"{printable(line)}\n".encode())

    try:
        yield say
    finally:
        sys.stdout.flush()
        os.dup2(ours, 1)
        os.close(ours)


@contextlib.contextmanager
def stopped_by_signals() -> Iterator[Callable[[], bool]]:
    """Whether Ctrl-C or SIGTERM has come; a second signal ends the process at once.

    An exception would be lost: raised while Cycles calls Python, it is only printed.
    """
    asked = []

    def note(*_: object) -> None:
        if asked:
            os._exit(CANCELLED)
        asked.append(True)

    before = {}
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, note)
    except ValueError:  # not in the main thread
        pass
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)


@dataclasses.dataclass
class Report:
    """Results so far."""

    done: list[str] = dataclasses.field(default_factory=list)
    """Subjects that were finished now."""
    failed: list[dict[str, str]] = dataclasses.field(default_factory=list)
    """For each failure: subject (empty for none), what was tried, and why it failed."""
    skipped: list[str] = dataclasses.field(default_factory=list)
    """Subjects that were finished before."""
    notes: list[str] = dataclasses.field(default_factory=list)
    """Notes on scans and poses, a sentence each."""

    def fail(self, subject: str, what: str, why: str) -> str:
        """Note a failure; returns it as one line."""
        why = printable(" ".join(why.split()))
        self.failed.append({"subject": subject, "what": what, "why": why})
        return f"{subject or what}: {why}"

    def write(self, root: Path, shard: tuple[int, int]) -> None:
        """To report.json, or report-i-of-n.json of one shard among several."""
        write_atomically(report_path(root, shard), json.dumps(dataclasses.asdict(self), indent=1))


def report_path(root: Path, shard: tuple[int, int]) -> Path:
    """Path of a shard's report."""
    return root / ("report.json" if shard[1] == 1 else f"report-{shard[0]}-of-{shard[1]}.json")
