"""The extension's command line: `blender -c primdiffusion ...`, `python -m blender_primdiffusion ...`."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import bpy

from ...console import DONE, UNUSABLE
from ...places import missing_packages

COMMAND = "primdiffusion"
_HELP = """\
blender -c primdiffusion generate --count 50 --seed 7 --out PEOPLE     humans in folders
blender -c primdiffusion render PEOPLE --out PICTURES                  pictures of them, or of a .blend
blender -c primdiffusion capture --people SCANS --out CAPTURES         captures from all sides, to train on
Each has more options: see --help.
Exit codes: 0 all done, 1 some failed, 2 usage error, 3 no Python runs the backend, 130 stopped by Ctrl-C."""
_handles: list[object] = []
"""Of the command, while it is registered."""


def execute(argv: Sequence[str]) -> int:
    """Run a command; returns its exit code."""
    command, words = argv[:1], list(argv[1:])
    try:
        if command == ["generate"]:
            from .generate import main  # each command loads its own modules
        elif command == ["render"]:
            from .render import main  # needs numpy
        elif command == ["capture"]:
            from ...capture.command import main  # needs numpy
    except ModuleNotFoundError:
        if not (lacking := missing_packages()):
            raise
        print(f"{command[0]}: {lacking}", file=sys.stderr, flush=True)
        return UNUSABLE
    if command not in (["generate"], ["render"], ["capture"]):
        asked = command in (["--help"], ["-h"])
        print(_HELP, file=sys.stdout if asked else sys.stderr, flush=True)
        return DONE if asked else UNUSABLE
    return main(words)


def register() -> None:
    """Register the command with Blender."""
    _handles.append(bpy.utils.register_cli_command(COMMAND, execute))


def unregister() -> None:
    """Undo `register`."""
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
