"""The extension's command line: `blender -c primdiffusion ...`, `python -m blender_primdiffusion ...`."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import bpy

from ...capture import command as capture
from ...console import DONE, UNUSABLE
from . import generate, render

COMMAND = "primdiffusion"
_HELP = """\
blender -c primdiffusion generate --count 50 --seed 7 --out PEOPLE     humans in folders
blender -c primdiffusion render PEOPLE --out PICTURES                  pictures of them, or of a .blend
blender -c primdiffusion capture --people SCANS --out CAPTURES         captures from all sides, to train on
Each has more options: see --help.
Exit codes: 0 all done, 1 some failed, 2 usage error, 3 no Python runs the backend, 130 stopped by Ctrl-C."""
_MAINS = {"generate": generate.main, "render": render.main, "capture": capture.main}
_handles: list[object] = []
"""Of the command, while it is registered."""


def execute(argv: Sequence[str]) -> int:
    """Run a command; returns its exit code."""
    command = argv[0] if argv else ""
    if command in _MAINS:
        return _MAINS[command](list(argv[1:]))
    asked = len(argv) == 1 and command in ("--help", "-h")
    print(_HELP, file=sys.stdout if asked else sys.stderr, flush=True)
    return DONE if asked else UNUSABLE


def register() -> None:
    """Register the command with Blender."""
    _handles.append(bpy.utils.register_cli_command(COMMAND, execute))


def unregister() -> None:
    """Undo `register`."""
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
