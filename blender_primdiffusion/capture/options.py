"""The options of the command `capture`, and its output for programs."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NoReturn, get_args

import numpy as np

from ..console import UsageError
from ..formats.arrays import all_finite
from ..formats.camera_rig import Arrangement, Rig, View
from ..formats.json_files import read_json
from ..formats.poses.files import ENDINGS
from ..formats.regular_files import as_file_error
from ..formats.requests import LAYOUTS, PASSES, check_seed
from .settings import Background, CaptureSettings, Device, Light

MARK = "PRIMDIFFUSION "
"""Begins each line of --progress json; an object follows: {"line": ...}, or the fields of `job.Progress`."""
ASK_FROM = 100
"""Views, before which a user at a terminal is asked."""


def parser() -> argparse.ArgumentParser:
    """All options of the command, with their defaults."""
    rig = Rig()
    made = argparse.ArgumentParser(
        prog="capture", description="Render people from all sides in Cycles, into a dataset."
    )
    made.error = _raise_usage_error
    add = made.add_argument
    add("--people", type=Path, nargs="+", default=[], help="folders of scans, or of what `primdiffusion people` made")
    add("--out", type=Path, required=True, help="the dataset's folder; an unfinished one is resumed")
    add("--seed", type=_seed, default=0, help="of the choice of poses and of the noise (default %(default)s)")
    add("--only", nargs="+", default=[], metavar="SUBJECT", help="only these subjects")
    add("--shard", type=_shard, default=(0, 1), metavar="I/N", help="the people I, I + N, ... of the sorted list")
    add("--together", type=int, default=1, metavar="N", help="stand N people together on a floor, at most 8")
    add("--shadows", action="store_true", help="those of --together shade each other under a dome or HDRI light")
    add("--body", type=Path, help="an SMPL body as .npz of plain arrays instead of the default one")
    add("--pose-files", type=Path, nargs="+", default=[], help="poses: .npz, .npy, .json, .pkl, .bvh, or folders")
    add("--poses", type=int, default=20, help="how many; the first is near-T (default %(default)s)")
    add("--cameras", type=int, default=rig.count, help="how many (default %(default)s)")
    add("--arrangement", choices=get_args(Arrangement), default=rig.arrangement)
    add("--elevations", type=float, nargs="+", default=rig.elevations, help="of rings, degrees above the horizon")
    add("--fov", type=float, default=rig.vertical_fov, help="vertical, degrees (default %(default)s)")
    add("--size", type=int, nargs=2, default=(rig.width, rig.height), metavar=("WIDTH", "HEIGHT"))
    add("--margin", type=float, default=rig.margin, help="room around people (default %(default)s)")
    add("--camera-file", type=Path, help='fixed cameras: {"camera0000": {"K": 3x3, "R": 3x3, "T": [3]}, ...}')
    add("--passes", nargs="+", default=PASSES, choices=PASSES)
    add("--float-depth", action="store_true", help="also depth as OpenEXR, float32")
    add("--light", choices=get_args(Light), default="uniform")
    add("--hdri", type=Path, help="the picture of --light hdri, or a folder of them, one for each view")
    add("--background", choices=get_args(Background), default="black", help="hdri: one more pass, over the HDRI")
    add("--samples", type=int, default=16, help="of a pixel (default %(default)s)")
    add("--denoise", action="store_true", help="of img under a dome or HDRI light")
    add("--device", choices=get_args(Device), default="auto")
    add("--threads", type=int, default=0, help="of Cycles on the CPU; 0: all")
    add("--layouts", nargs="*", default=LAYOUTS, choices=LAYOUTS, help="camera files of other projects")
    add(
        "--released-reference",
        action="store_true",
        help="the first subject also under the name the released code needs",
    )
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
    rig = Rig(
        arrangement=options.arrangement,
        count=options.cameras,
        elevations=tuple(options.elevations),
        vertical_fov=options.fov,
        width=width,
        height=height,
        margin=options.margin,
    )
    return CaptureSettings(
        out=options.out,
        seed=options.seed,
        rig=rig,
        cameras=read_cameras(options.camera_file, width, height) if options.camera_file else (),
        pose_files=tuple(_files_of_poses(options.pose_files)),
        pose_count=options.poses,
        passes=tuple(kind for kind in PASSES if kind in options.passes),
        float_depth=options.float_depth,
        light=options.light,
        hdri=options.hdri,
        background=options.background,
        samples=options.samples,
        denoise=options.denoise,
        device=options.device,
        threads=options.threads,
        shard=options.shard,
        together=options.together,
        shadows=options.shadows,
        layouts=tuple(options.layouts),
        released_reference=options.released_reference,
        body=options.body,
    )


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


def _raise_usage_error(message: str) -> NoReturn:
    raise UsageError(message)


def _seed(text: str) -> int:
    try:
        check_seed(seed := int(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return seed


def _shard(text: str) -> tuple[int, int]:
    index, _, count = text.partition("/")
    if not (index.isdigit() and count.isdigit() and int(index) < int(count)):
        raise argparse.ArgumentTypeError(f"{text!r} is no shard: 0/4 is the first of four")
    return int(index), int(count)
