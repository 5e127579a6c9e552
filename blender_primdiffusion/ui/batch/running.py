"""What commands have in common: options, lines on stdout, files written whole, report, exit codes."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ...capture.report import Report, report_path
from ...console import (
    CANCELLED,
    DONE,
    FAILED,
    NO_BACKEND,
    UNUSABLE,
    Stop,
    duration,
    stdout_of_our_own,
    stopped_by_signals,
)
from ...formats.capture_layout import replacing
from .asking import NoBackend, Stopped
from .words import UsageError


@contextmanager
def staging(folder: Path) -> Iterator[Path]:
    """An empty folder beside `folder`, to be published; gone after the block, and first if a killed run left one."""
    made = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir(parents=True)
    try:
        yield made
    finally:
        shutil.rmtree(made, ignore_errors=True)


def publish(made: Path, folder: Path, last: str) -> None:
    """Give what is in `made` to `folder`: at once where that is new, else piece by piece, the file `last` last."""
    if not folder.exists():
        os.replace(made, folder)
        return
    for piece in sorted(made.iterdir(), key=lambda path: path.name == last):
        target = folder / piece.name
        if target.is_dir():
            shutil.rmtree(target)
        os.replace(piece, target)


def claim(path: Path, settings: Mapping[str, Any], whatever_is_there: bool) -> None:
    """Write the settings of a batch to the .json at `path`. Raises ValueError where other ones are there, and OSError.

    `whatever_is_there`: the settings are then those of what is still to come.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(path.parent, error) from error
    wanted = json.loads(json.dumps(settings))
    if path.is_file() and not whatever_is_there:
        try:
            there = dict(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} is damaged ({error}): choose another folder, or add --resume") from error
        for name in sorted({*wanted, *there}):
            if there.get(name) != wanted.get(name):
                raise ValueError(
                    f"what is in {path.parent} was made with {name} = {there.get(name)}, not {wanted.get(name)}: "
                    "choose another folder, or add --resume to keep it"
                )
    try:
        with replacing(path) as unfinished:
            unfinished.write_text(json.dumps(wanted, indent=1), encoding="utf-8")
    except OSError as error:
        raise _unwritable(path.parent, error) from error


def _unwritable(folder: Path, error: OSError) -> OSError:
    return OSError(f"nothing can be written to {folder} ({error.strerror or error}): choose another folder with --out")


Say = Callable[[str], None]
"""Takes a line for people."""
_ALL = (0, 1)
"""The shard of a batch that is not shared out."""


def run(
    name: str,
    argv: Sequence[str],
    parse: Callable[[Sequence[str]], argparse.Namespace],
    work: Callable[[argparse.Namespace, Say, Stop], Report],
) -> int:
    """Run a command; returns its exit code. Blender's own messages on stdout are dropped.

    `work` raises Stopped, NoBackend, and OSError or ValueError where nothing can be begun.
    """
    try:
        options = parse(argv)
    except UsageError as error:
        return _refused(name, f"{error}; --help names all options", UNUSABLE)
    except SystemExit as asked_for_help:
        return int(asked_for_help.code or DONE)
    with stdout_of_our_own() as say, stopped_by_signals() as stop:
        try:
            report = work(options, say, stop)
        except Stopped:
            say("Stopped; the same command resumes from here.")
            return CANCELLED
        except NoBackend as error:
            return _refused(name, str(error), NO_BACKEND)
        except (OSError, ValueError) as error:
            return _refused(name, str(error), UNUSABLE)
        say(f"{len(report.done)} done, {len(report.skipped)} were there, {len(report.failed)} failed")
        if report.failed:
            say(f"What failed and why: {report_path(options.out, _ALL)}")
        return FAILED if report.failed else DONE


@contextmanager
def begun(report: Report, claimed: Path, settings: Mapping[str, Any], whatever_is_there: bool) -> Iterator[None]:
    """A batch under way: its settings are claimed (see `claim`), its report is written beside them in the end.

    Neither stays where no backend was found for the first of it: another try may have other settings. Raises ValueError
    and OSError as `claim` does.
    """
    out, nothing = claimed.parent, False
    is_new, is_new_folder = not claimed.is_file(), not out.exists()
    claim(claimed, settings, whatever_is_there)
    try:
        yield
    except NoBackend:
        nothing = is_new and not (report.done or report.failed)
        raise
    finally:
        if not nothing:
            report.write(out, _ALL)
        else:
            claimed.unlink(missing_ok=True)
            if is_new_folder:
                out.rmdir()


def reason(error: Exception) -> str:
    """What an error says, in a line; with its kind where it was not meant for people."""
    meant = isinstance(error, (ValueError, OSError, RuntimeError)) and str(error).strip()
    return " ".join((str(error) if meant else f"{type(error).__name__}: {error}").split()).removeprefix("Error: ")


def _refused(name: str, sentence: str, code: int) -> int:
    print(f"{name}: {sentence}", file=sys.stderr, flush=True)
    return code


class Clock:
    """How long a batch will still take, by what its pieces took so far."""

    def __init__(self, pieces: int):
        self._left, self._made, self._began = pieces, 0, time.monotonic()

    def piece_made(self) -> str:
        """One more is there; the time that is left, in words."""
        self._made += 1
        self._left -= 1
        if not self._left:
            return ""
        each = (time.monotonic() - self._began) / self._made
        return f", {duration(self._left * each)} left"

    def piece_skipped(self) -> None:
        """One was there already."""
        self._left -= 1
