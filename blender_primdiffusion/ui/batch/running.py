"""What the commands share: requests to the child, lines on stdout, files written whole, the report, exit codes."""

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

import bpy

from ...backend.environment import VARIABLE, BackendNotFound
from ...backend.requests import Backend, ChildRequest
from ...console import (
    CANCELLED,
    DONE,
    FAILED,
    NO_BACKEND,
    UNUSABLE,
    Report,
    Stop,
    Stopped,
    duration,
    report_path,
    separate_stdout,
    stopped_by_signals,
)
from ...formats import whole_files
from ...formats.json_files import parse_json, read_json
from ...formats.regular_files import as_file_error, printable, remove_file
from ...formats.whole_files import remove_abandoned, temporary_folder, write_atomically
from ...places import EXTENSION, new_backend, preference

_TICK_S = 0.03


@contextmanager
def backend_of(python: Path | None) -> Iterator[Backend]:
    """A child on this Python, or the preferences'; started at first use, ended with the block."""
    backend = new_backend(preference("backend_python") if python is None else absolute(python))
    try:
        yield backend
    finally:
        backend.shutdown()


@contextmanager
def python_for_engine(python: Path | None) -> Iterator[None]:
    """Use this Python for the render engine too, which reads the preferences and the environment."""
    if python is None:
        yield
        return
    addon = bpy.context.preferences.addons.get(EXTENSION)
    before, variable = (addon.preferences.backend_python if addon else ""), os.environ.get(VARIABLE)
    os.environ[VARIABLE] = absolute(python)
    if addon is not None:
        addon.preferences.backend_python = absolute(python)
    try:
        yield
    finally:
        if addon is not None:
            addon.preferences.backend_python = before
        if variable is None:
            del os.environ[VARIABLE]
        else:
            os.environ[VARIABLE] = variable


def absolute(program: Path) -> str:
    """The absolute path of a program on the command line, which may be relative or one on the PATH."""
    return os.path.abspath(shutil.which(program) or program)


def check_backend(python: Path | None) -> None:
    """Raises BackendNotFound where no child can be started."""
    with backend_of(python) as backend:
        try:
            backend.connect()
        except (RuntimeError, OSError) as error:
            raise BackendNotFound(str(error)) from error


def ask(
    backend: Backend,
    method: str,
    params: Mapping[str, Any],
    stop: Stop,
    on_progress: Callable[[ChildRequest], None] = lambda _request: None,
) -> Any:
    """The child's answer, a record of `formats.answers`; `on_progress` is called with the request whenever it changes.

    Raises BackendNotFound, RuntimeError with the child's error, and Stopped once `stop` is set, within a second; then
    no file is left.
    """
    request = ChildRequest(backend, method, params)
    while not request.finished:
        if stop.is_set():
            request.cancel()
        if request.tick():
            on_progress(request)
        time.sleep(_TICK_S)
    if request.state == "cancelled":
        raise Stopped
    if request.error is not None:
        kind = BackendNotFound if request.error.kind in {"environment", "timeout"} else RuntimeError
        raise kind(str(request.error))
    return request.result


@contextmanager
def staging(folder: Path) -> Iterator[Path]:
    """An empty folder beside `folder`, to be published; removed after the block. A killed run may have left one."""
    remove_abandoned(folder.parent, folder)
    with temporary_folder(folder) as made:
        yield made


def publish(made: Path, folder: Path, last: str) -> None:
    """Move the content of `made` to `folder`: at once if that is new, else all or nothing, `last` last."""
    if folder.exists():
        whole_files.publish([(made, folder)], last)
    else:
        os.replace(made, folder)


def claim(path: Path, settings: Mapping[str, Any], whatever_is_there: bool) -> None:
    """Write the settings of a batch to the .json at `path`. Raises ValueError where other ones are there, and OSError.

    `whatever_is_there`: accept other settings, of what was made before.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(path.parent, error) from error
    wanted = parse_json(json.dumps(settings))
    if path.is_file() and not whatever_is_there:
        with as_file_error(path, "is damaged", "choose another folder, or add --resume"):
            there = dict(read_json(path))
        for name in sorted({*wanted, *there}):
            if there.get(name) != wanted.get(name):
                raise ValueError(
                    f"what is in {path.parent} was made with {name:.40} = {there.get(name)!s:.60}, not "
                    f"{wanted.get(name)!s:.60}: choose another folder, or add --resume to keep it"
                )
    try:
        write_atomically(path, json.dumps(wanted, indent=1))
    except OSError as error:
        raise _unwritable(path.parent, error) from error


def _unwritable(folder: Path, error: OSError) -> OSError:
    return OSError(f"nothing can be written to {folder} ({error.strerror or error}): choose another folder with --out")


Say = Callable[[str], None]
"""Prints a line."""
_ALL = (0, 1)
"""The shard of a batch that is not divided."""


def run(
    name: str,
    argv: Sequence[str],
    parse: Callable[[Sequence[str]], argparse.Namespace],
    work: Callable[[argparse.Namespace, Say, Stop], Report],
) -> int:
    """Run a command; returns its exit code. Blender's own messages on stdout are dropped.

    `work` raises Stopped, BackendNotFound, and OSError or ValueError where nothing can be begun.
    """
    try:
        options = parse(argv)
    except ValueError as error:
        return _failed(name, f"{error}; --help names all options", UNUSABLE)
    except SystemExit as asked_for_help:
        return int(asked_for_help.code or DONE)
    with separate_stdout() as say, stopped_by_signals() as stop:
        try:
            report = work(options, say, stop)
        except Stopped:
            say("Stopped; the same command resumes from here.")
            return CANCELLED
        except BackendNotFound as error:
            return _failed(name, str(error), NO_BACKEND)
        except (OSError, ValueError) as error:
            return _failed(name, str(error), UNUSABLE)
        say(f"{len(report.done)} done, {len(report.skipped)} were there, {len(report.failed)} failed")
        if report.failed:
            say(f"What failed and why: {report_path(options.out, _ALL)}")
        return FAILED if report.failed else DONE


@contextmanager
def begun(report: Report, claimed: Path, settings: Mapping[str, Any], whatever_is_there: bool) -> Iterator[None]:
    """A running batch: claims its settings (see `claim`), and writes its report beside them in the end.

    Neither stays where no backend was found for the first human. Raises ValueError and OSError as `claim` does.
    """
    out, nothing = claimed.parent, False
    is_new, is_new_folder = not claimed.is_file(), not out.exists()
    claim(claimed, settings, whatever_is_there)
    try:
        yield
    except BackendNotFound:
        nothing = is_new and not (report.done or report.failed)
        raise
    finally:
        if not nothing:
            report.write(out, _ALL)
        else:
            remove_file(claimed, claimed.parent)
            if is_new_folder:
                out.rmdir()


def reason(error: Exception) -> str:
    """The message of an error on one line; with its class where it is unexpected."""
    expected = isinstance(error, (ValueError, OSError, RuntimeError)) and str(error).strip()
    return " ".join((str(error) if expected else f"{type(error).__name__}: {error}").split()).removeprefix("Error: ")


def _failed(name: str, sentence: str, code: int) -> int:
    print(printable(f"{name}: {sentence}"), file=sys.stderr, flush=True)
    return code


class Clock:
    """Estimates how long a batch will take, from its pieces so far."""

    def __init__(self, pieces: int):
        self._left, self._made, self._began = pieces, 0, time.monotonic()

    def piece_made(self) -> str:
        """Count a finished piece; returns the time left as text."""
        self._made += 1
        self._left -= 1
        if not self._left:
            return ""
        each = (time.monotonic() - self._began) / self._made
        return f", {duration(self._left * each)} left"

    def piece_skipped(self) -> None:
        """Count a piece that existed before."""
        self._left -= 1


def attempt(
    name: str, what: str, make: Callable[[], bool], report: Report, clock: Clock, stop: Stop, say: Say, which: str = ""
) -> None:
    """Make a piece of a batch, and report it: one that fails must not end the batch of a night.

    `make` returns whether anything was missing. Raises Stopped and BackendNotFound.
    """
    if stop.is_set():
        raise Stopped
    label = f"{which} {name}".strip()
    try:
        made = make()
    except (BackendNotFound, Stopped):
        raise
    except Exception as error:
        report.fail(name, what, reason(error))
        say(f"{label} failed: {reason(error)}{clock.piece_made()}")
        return
    if made:
        report.done.append(name)
        say(f"{label} done{clock.piece_made()}")
    else:
        report.skipped.append(name)
        clock.piece_skipped()
