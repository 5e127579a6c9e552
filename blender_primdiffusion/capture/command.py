"""Captures from a command line.

`blender -c primdiffusion capture ...` with the extension enabled, `python -m blender_primdiffusion.capture ...` with
Blender as a Python module, `blender -b --factory-startup --python launch.py -- ...` without either.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Sequence

import bpy

from ..backend.child_streams import stdin_has_ended
from ..console import (
    CANCELLED,
    DONE,
    FAILED,
    UNUSABLE,
    Report,
    Stop,
    UsageError,
    duration,
    report_path,
    separate_stdout,
    stopped_by_signals,
)
from ..formats.capture_repair import repair, verify
from ..formats.regular_files import FileError
from .job import CaptureProgress, run
from .options import ASK_FROM, MARK, parse, settings_of
from .scan import ScanFile, find_scans
from .settings import CaptureSettings

_PRINT_S = 1.0
"""Between lines of progress."""

Say = Callable[..., None]
"""Prints a line; with --progress json, also a CaptureProgress."""


class _Stopped(Exception):
    """The command was asked to stop."""


def main(argv: Sequence[str]) -> int:
    """Run the command; returns its exit code. Blender's own messages on stdout are dropped."""
    try:
        options = parse(argv)
    except UsageError as error:
        print(f"capture: {error}; --help names all options", file=sys.stderr, flush=True)
        return UNUSABLE
    with separate_stdout() as write:
        say = _json_lines(write) if options.progress == "json" else write
        try:
            if not _agreed(options, say):
                return CANCELLED
            with stopped_by_signals() as stop:
                return _run(options, say, stop)
        except (OSError, ValueError) as error:
            print(f"capture: {error}", file=sys.stderr, flush=True)
            return UNUSABLE
        except _Stopped:
            say("Stopped; the same command resumes from here.")
            return CANCELLED


def scans_in(folders: Sequence, only: Sequence[str] = ()) -> list[ScanFile]:
    """The scans of some folders, sorted by name; of `only`, where names are given.

    Raises FileError where there are none, or two of a name.
    """
    found: dict[str, ScanFile] = {}
    for folder in folders:
        for scan in find_scans(folder):
            if scan.name in found:
                raise FileError(f"two scans are called {scan.name}: rename the file or folder of one")
            found[scan.name] = scan
    unknown = sorted(set(only) - set(found))
    if unknown:
        raise FileError(f"there is no scan {unknown[0]} in {', '.join(map(str, folders))}")
    if not found:
        raise FileError("there are no scans: name a folder of them with --people")
    return [found[name] for name in sorted(found) if not only or name in only]


_SECONDS_A_VIEW = 2.2
"""Of 512 x 512 pixels and 16 samples on two processor cores: benchmarks/captures.py."""


def estimate(settings: CaptureSettings, people: int) -> tuple[int, str]:
    """Views of a run on this many scans, those that exist included, and a sentence that says how long they take."""
    index, shards = settings.shard
    people = len(range(index, people, shards))
    views = people * settings.pose_count * settings.camera_count
    size = settings.cameras[0] if settings.cameras else settings.rig
    seconds = views * _SECONDS_A_VIEW * size.width * size.height / 512**2 * settings.samples / 16
    return views, (
        f"{views} views ({people} {'person' if people == 1 else 'people'} x {settings.pose_count} poses x "
        f"{settings.camera_count} cameras) take about {duration(seconds)} on two processor cores"
    )


def _agreed(options: argparse.Namespace, say: Say) -> bool:
    """Print the estimate of a run; ask at a terminal where it is long."""
    if options.verify or options.list or not options.people or options.progress != "text":
        return True
    views, sentence = estimate(settings_of(options), len(scans_in(options.people, options.only)))
    say(f"{sentence}; finished ones are skipped")
    if views < ASK_FROM or options.yes or options.while_stdin or not sys.stdin or not sys.stdin.isatty():
        return True
    say("Render them? [y/N]")
    return sys.stdin.readline().strip().lower() in {"y", "yes"}


def _run(options: argparse.Namespace, say: Say, stop: Stop) -> int:
    if options.verify or (options.repair and not options.people):
        return _check(options, say)
    if options.repair and options.out.exists():
        _check(options, say)
    settings = settings_of(options)
    if settings.together > 1 and options.only:
        raise ValueError("people who stand together need each other: give --shard instead of --only")
    scans = scans_in(options.people, options.only)
    if options.list:
        index, count = settings.shard
        for scan in scans[index::count]:
            say(scan.name)
        return DONE
    if options.while_stdin:
        stop.ended = stdin_has_ended
    return _render(options, settings, scans, say, stop)


def _check(options: argparse.Namespace, say: Say) -> int:
    wrong = verify(options.out)
    if options.repair:
        repair(options.out, wrong)
    for path, what in wrong.items():
        say(f"{path}: {what}")
    say(f"{options.out}: {f'{len(wrong)} problems' if wrong else 'no problems'}")
    return FAILED if wrong else DONE


def _render(options: argparse.Namespace, settings: CaptureSettings, scans: list[ScanFile], say: Say, stop: Stop) -> int:
    try:
        settings.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise FileError(
            f"nothing can be written to {settings.out} ({reason}): choose another folder with --out"
        ) from error
    report, printed = Report(), 0.0
    with contextlib.closing(run(bpy.context, settings, scans, report)) as steps:
        for progress in steps:
            if options.progress == "json":
                say(progress)
            elif options.progress == "text":
                for line in progress.news:
                    say(line)
                if time.monotonic() - printed > _PRINT_S or progress.done == progress.total:
                    printed = time.monotonic()
                    say(describe(progress))
            if stop.is_set():
                raise _Stopped
    say(f"{len(report.done)} done, {len(report.skipped)} were there, {len(report.failed)} failed")
    if report.failed:
        say(f"What failed and why: {report_path(settings.out, settings.shard)}")
    return FAILED if report.failed else DONE


def _json_lines(write: Callable[[str], None]) -> Say:
    """Lines of ours begin with MARK, unlike Blender's."""

    def say(what: str | CaptureProgress) -> None:
        write(MARK + json.dumps({"line": what} if isinstance(what, str) else dataclasses.asdict(what)))

    return say


def describe(progress: CaptureProgress) -> str:
    """Progress as a line of text."""
    left = "" if progress.eta_s is None else f", {duration(progress.eta_s)} left"
    return f"{progress.subject}: view {progress.done} of {progress.total}{left}"
