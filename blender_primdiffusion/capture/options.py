"""The options of the command `capture`, and its output for programs."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..console import CommandParser
from ..formats.arrays import all_finite
from ..formats.camera_rig import Rig, View
from ..formats.json_files import read_json
from ..formats.poses.files import ENDINGS
from ..formats.regular_files import as_file_error
from ..formats.requests import LAYOUTS, PASSES
from .settings import CaptureSettings

MARK = "PRIMDIFFUSION "
"""Begins each line of --progress json; an object follows: {"line": ...}, or the fields of `job.Progress`."""
ASK_FROM = 100
"""Views, before which a user at a terminal is asked."""


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
    declared(CaptureSettings, "shadows")
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
    declared(CaptureSettings, "layouts", type=str, nargs="*", choices=LAYOUTS)
    declared(CaptureSettings, "released_reference")
    add("--list", action="store_true", help="list the subjects of the shard, render nothing")
    add("--yes", action="store_true", help=f"do not ask before {ASK_FROM} views or more; only a terminal is asked")
    add("--verify", action="store_true", help="check the dataset, render nothing")
    add("--repair", action="store_true", help="with --verify: remove damaged files; without: then render them again")
    add("--progress", choices=("text", "json", "none"), default="text", help="on stdout")
    add("--while-stdin", action="store_true", help="stop when stdin ends: for programs that start this one")
    return made


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """The options in `argv`. Raises UsageError; SystemExit after --help."""
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
    """The cameras of a cameras.json, in the order of their names. Raises FileError or OSError."""
    with as_file_error(path, "holds no cameras as cameras.json has them", "render the captures again"):
        named = read_json(path)
        views = []
        for name in sorted(named):
            k, r, t = (np.array(named[name][key], np.float64) for key in "KRT")
            if (k.shape, r.shape, t.size) != ((3, 3), (3, 3), 3) or not all(map(all_finite, (k, r, t))):
                raise ValueError(f"{name} has no finite K [3, 3], R [3, 3] and T [3]")
            if not np.allclose(r @ r.T, np.eye(3), atol=1e-5) or np.linalg.det(r) < 0:
                raise ValueError(f"R of {name} is not a rotation")
            views.append(View(k, r, t.ravel(), width, height))
        if not views:
            raise ValueError("the list is empty")
    return tuple(views)


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
        raise argparse.ArgumentTypeError(f"{text!r} is no shard: 0/4 is the first of four")
    return int(index), int(count)
