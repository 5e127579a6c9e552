"""The options of the commands `generate` and `render`."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

from ...console import CommandParser
from ...formats.regular_files import real_path
from ...formats.requests import GenerateRequest
from ...formats.schema import read

ENGINES = {"primdiffusion": "PRIMDIFFUSION", "cycles": "CYCLES"}
"""Names of render engines on the command line -> Blender's."""
DECLARED = {"steps": "--steps", "sampler": "--sampler", "guidance": "--guidance", "size": "--pictures"}
"""Options of `generate` by the field of the request that declares them."""
_EPILOG = (
    "exit codes: 0 all is done, 1 some failed (report.json says which and why), 2 usage error, 3 no Python runs the "
    "backend, 130 stopped by Ctrl-C; the same command resumes"
)


def parse_generate(argv: Sequence[str]) -> argparse.Namespace:
    """The options of `generate`. Raises ValueError; SystemExit after --help."""
    made = _parser("generate", "Generate humans, a folder each: the human, its files for Blender, pictures.")
    add = made.add_argument
    add("--out", type=Path, required=True, help="folder for the humans; an unfinished one is resumed")
    add("--count", type=_whole(1), default=1, help="how many (default %(default)s)")
    add("--seed", type=int, default=0, help="of the first; the others follow on it (default %(default)s)")
    for field, option in DECLARED.items():
        made.add_declared(GenerateRequest, field, option)
    add("--attributes", nargs="+", default=[], metavar="NAME=VALUE", help='like sex=female height=1.7 "hair=long bob"')
    add("--checkpoint", type=Path, help="a .safetensors file instead of the preferences' or the default one")
    blend = made.add_mutually_exclusive_group()
    blend.add_argument(
        "--blend", nargs="?", const="person.blend", metavar="NAME", help="a .blend in each folder too, called so"
    )
    blend.add_argument("--no-blend", dest="blend", action="store_const", const=None, help="none (the default)")
    _add_motion(made)
    _add_python(made)
    add("--resume", action="store_true", help="keep humans in the folder that were generated with other settings")
    options = made.parse_args(list(argv))
    sampling = {field: getattr(options, field) for field in DECLARED}
    for seed in (options.seed, options.seed + options.count - 1):
        read(GenerateRequest, {"seed": seed, "out_dir": options.out, **sampling})
    if options.blend is not None and (Path(options.blend).name != options.blend or not options.blend.strip(".")):
        raise ValueError(f"--blend {options.blend!r} is no file name: name one without folders")
    if options.blend is not None and not options.blend.endswith(".blend"):
        options.blend += ".blend"
    if (options.pose or options.motion) and options.blend is None:
        raise ValueError("--pose and --motion move humans in .blend files: add --blend")
    _check_files(options, "checkpoint", "pose", "motion")
    return options


def parse_render(argv: Sequence[str]) -> argparse.Namespace:
    """The options of `render`. Raises ValueError; SystemExit after --help."""
    made = _parser("render", "Render a .blend, a human's file, or all humans in a folder.")
    add = made.add_argument
    add("source", type=Path, metavar="SOURCE", help=".blend, .human, .human.safetensors, or a folder of humans")
    add("--out", type=Path, required=True, help="folder for the pictures; those that are there stay")
    add("--engine", choices=ENGINES, help="default: the .blend's own; primdiffusion for humans")
    add("--frames", type=_frames, metavar="A..B", help="default: the frame the .blend is at; all of a --motion")
    add("--size", type=_size, metavar="WxH", help="pixels; default: the .blend's own; 512x512 for humans")
    add("--yaw", type=float, help="degrees from the front towards the humans' left, for a new camera")
    add("--turntable", type=_whole(2), metavar="N", help="N views all round")
    _add_motion(made)
    add("--transparent", action="store_true", help="no background")
    add("--samples", type=_whole(1), help="of Cycles, for each pixel (default 4)")
    _add_python(made)
    add("--resume", action="store_true", help="keep pictures in the folder that were rendered with other settings")
    options = made.parse_args(list(argv))
    if options.turntable and options.frames:
        raise ValueError("--turntable and --frames ask for different pictures: give one of them")
    if options.samples and options.engine == "primdiffusion":
        raise ValueError("--samples is for --engine cycles; the marcher needs none")
    if not options.source.exists():
        raise ValueError(f"there is no {options.source}: check the path")
    _check_files(options, "pose", "motion")
    return options


def motion_name(options: argparse.Namespace) -> str | None:
    """The absolute path of what --pose or --motion names."""
    path = options.pose or options.motion
    return None if path is None else str(real_path(path))


def _parser(name: str, description: str) -> CommandParser:
    return CommandParser(prog=f"primdiffusion {name}", description=description, epilog=_EPILOG)


def _add_motion(made: argparse.ArgumentParser) -> None:
    moved = made.add_mutually_exclusive_group()
    moved.add_argument("--pose", type=Path, metavar="FILE", help="stand as in its first frame: .npz, .json, .pkl, .bvh")
    moved.add_argument("--motion", type=Path, metavar="FILE", help="move as in it: AMASS .npz, .npy, .json, .pkl, .bvh")


def _add_python(made: argparse.ArgumentParser) -> None:
    made.add_argument("--python", type=Path, metavar="PATH", help="the backend's Python instead of the preferences'")


def _check_files(options: argparse.Namespace, *names: str) -> None:
    if options.out.exists() and not options.out.is_dir():
        raise ValueError(f"--out {options.out} is a file: name a folder")
    for name in names:
        path = getattr(options, name)
        if path is not None and not path.is_file():
            raise ValueError(f"--{name} {path} is no file: check the path")


def _whole(least: int):
    """Whole numbers from `least` on."""

    def number(text: str) -> int:
        if not text.isdigit() or int(text) < least:
            raise ValueError(text)
        return int(text)

    number.__name__ = f"whole number from {least}"
    return number


def _frames(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(-?\d+)(?:\.\.(-?\d+))?", text)
    first, last = (int(found[1]), int(found[2] or found[1])) if found else (1, 0)
    if last < first:
        raise ValueError(text)
    return first, last


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if not found or not all(4 <= int(side) <= 65536 for side in found.groups()):
        raise ValueError(text)
    return int(found[1]), int(found[2])


_frames.__name__, _size.__name__ = "range of frames like 1..48", "size like 1920x1080"
