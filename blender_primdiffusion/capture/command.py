"""Captures from a command line, its options, and its output for programs.

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy

from ..backend.child_process import stdin_has_ended
from ..console import (
    CANCELLED,
    DONE,
    FAILED,
    UNUSABLE,
    CommandParser,
    Report,
    Stopped,
    duration,
    report_path,
    separate_stdout,
    stopped_by_signals,
)
from ..files.json_files import read_json
from ..files.regular_files import FileError, as_file_error, printable
from ..formats.camera_rig import Rig, View
from ..formats.capture_layout import views_in
from ..formats.poses.files import ENDINGS
from ..formats.requests import PASSES
from .job import CaptureProgress, run
from .scan_files import ScanFile, find_scans
from .settings import CaptureSettings

MARK = "PRIMDIFFUSION "
"""Begins each line of --progress json; an object follows: {"line": ...}, or the fields of `job.Progress`."""
_PRINT_S = 1.0
"""Between lines of progress."""

Say = Callable[..., None]
"""Prints a line; with --progress json, also a CaptureProgress."""


def parser() -> CommandParser:
    """All options of the command, with their defaults."""
    rig = Rig()
    made = CommandParser(prog="capture", description="Render people from all sides in Cycles, into a dataset.")
    add, declared = made.add_argument, made.add_declared
    add("--people", type=Path, nargs="+", default=[], help="folders of scans, or of what `primdiffusion people` made")
    add("--out", type=Path, required=True, help="the dataset's folder; an unfinished one is resumed")
    declared(CaptureSettings, "seed")
    add("--only", nargs="+", default=[], metavar="SUBJECT", help="only these subjects")
    add("--shard", type=_shard, default=(0, 1), metavar="I/N", help="the people I, I + N, ... of the sorted list")
    declared(CaptureSettings, "together", metavar="N")
    declared(CaptureSettings, "body")
    add("--pose-files", type=Path, nargs="+", default=[], help="poses: .npz, .npy, .json, .pkl, .bvh, or folders")
    declared(CaptureSettings, "pose_count", "--poses")
    declared(Rig, "count", "--cameras")
    declared(Rig, "arrangement")
    declared(Rig, "elevations", type=float, nargs="+")
    declared(Rig, "vertical_fov", "--fov")
    add("--size", type=int, nargs=2, default=(rig.width, rig.height), metavar=("WIDTH", "HEIGHT"))
    declared(Rig, "margin")
    add("--camera-file", type=Path, help='fixed cameras: {"camera0000": {"K": 3x3, "R": 3x3, "T": [3]}, ...}')
    declared(CaptureSettings, "passes", type=str, nargs="+", choices=PASSES)
    declared(CaptureSettings, "float_depth")
    declared(CaptureSettings, "light")
    declared(CaptureSettings, "hdri")
    declared(CaptureSettings, "background")
    declared(CaptureSettings, "samples")
    declared(CaptureSettings, "denoise")
    declared(CaptureSettings, "device")
    declared(CaptureSettings, "threads")
    declared(CaptureSettings, "released_reference")
    add("--list", action="store_true", help="list the subjects of the shard, render nothing")
    add("--progress", choices=("text", "json", "none"), default="text", help="on stdout")
    add("--while-stdin", action="store_true", help="stop when stdin ends: for programs that start this one")
    return made


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """The options in `argv`. Raises ValueError; SystemExit after --help."""
    return parser().parse_args(list(argv))


def settings_of(options: argparse.Namespace) -> CaptureSettings:
    """The settings that options ask for. Raises ValueError and OSError for impossible ones."""
    width, height = options.size
    given = vars(options) | {
        "rig": Rig(**_fields(Rig, vars(options) | {"width": width, "height": height})),
        "cameras": read_cameras(options.camera_file, width, height) if options.camera_file else (),
        "pose_files": tuple(_files_of_poses(options.pose_files)),
        "passes": tuple(kind for kind in PASSES if kind in options.passes),
    }
    return CaptureSettings(**_fields(CaptureSettings, given))


def _fields(record: type, given: Mapping[str, Any]) -> dict[str, Any]:
    """What is given for the fields of a record; lists, of options with several words, as tuples."""
    found = {field.name: given[field.name] for field in dataclasses.fields(record)}
    return {name: tuple(value) if isinstance(value, list) else value for name, value in found.items()}


def read_cameras(path: Path, width: int, height: int) -> tuple[View, ...]:
    """The cameras of a cameras.json. Raises FileError or OSError."""
    with as_file_error(path, "holds no cameras as cameras.json has them", "render the captures again"):
        return tuple(views_in(read_json(path), path, lambda _: (width, height)))


def _files_of_poses(paths: Sequence[Path]) -> Iterator[Path]:
    for path in paths:
        if not path.is_dir():
            yield path
            continue
        found = sorted(file for file in path.rglob("*") if file.suffix.lower() in ENDINGS and file.is_file())
        if not found:
            raise ValueError(f"{path} holds no pose files: {', '.join(ENDINGS)}")
        yield from found


def _shard(text: str) -> tuple[int, int]:
    index, _, count = text.partition("/")
    if not (index.isdigit() and count.isdigit() and int(index) < int(count)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a shard: 0/4 is the first of four")
    return int(index), int(count)


def main(argv: Sequence[str]) -> int:
    """Run the command; returns its exit code. Blender's own messages on stdout are dropped."""
    try:
        options = parse(argv)
    except ValueError as error:
        print(printable(f"capture: {error}; --help names all options"), file=sys.stderr, flush=True)
        return UNUSABLE
    with separate_stdout() as write:
        say = _json_lines(write) if options.progress == "json" else write
        try:
            with stopped_by_signals() as stopped:
                return _run(options, say, stopped)
        except (OSError, ValueError) as error:
            print(printable(f"capture: {error}"), file=sys.stderr, flush=True)
            return UNUSABLE
        except Stopped:
            say("Stopped; the same command resumes from here.")
            return CANCELLED


def scans_in(folders: Sequence, only: Sequence[str] = ()) -> list[ScanFile]:
    """The scans of some folders, sorted by name; of `only`, where names are given.

    Raises ValueError where there are none, and FileError for two of a name.
    """
    found: dict[str, ScanFile] = {}
    for folder in folders:
        for scan in find_scans(folder):
            if scan.name in found:
                reason = f"is called {scan.name}, as is {found[scan.name].path}"
                raise FileError(scan.path, reason, "rename the file or folder of one")
            found[scan.name] = scan
    unknown = sorted(set(only) - set(found))
    if unknown:
        raise FileError(", ".join(map(str, folders)), f"holds no scan {unknown[0]}", "correct --only")
    if not found:
        raise ValueError("there are no scans: name a folder of them with --people")
    return [found[name] for name in sorted(found) if not only or name in only]


def _run(options: argparse.Namespace, say: Say, stopped: Callable[[], bool]) -> int:
    settings = settings_of(options)
    if settings.together > 1 and options.only:
        raise ValueError("people who stand together need each other: give --shard instead of --only")
    scans = scans_in(options.people, options.only)
    if options.list:
        index, count = settings.shard
        for scan in scans[index::count]:
            say(scan.name)
        return DONE
    return _render(options, settings, scans, say, stopped)


def _render(
    options: argparse.Namespace, settings: CaptureSettings, scans: list[ScanFile], say: Say, stopped: Callable[[], bool]
) -> int:
    try:
        settings.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise FileError(settings.out, f"cannot be written to ({reason})", "choose another folder with --out") from error
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
            if stopped() or (options.while_stdin and stdin_has_ended()):
                raise Stopped
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
