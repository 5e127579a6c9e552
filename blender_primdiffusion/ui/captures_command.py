"""The extension's command line: `blender -c primdiffusion capture ...`."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import bpy

from ..capture.command import main
from ..console import DONE, UNUSABLE

COMMAND = "primdiffusion"
_HELP = """\
blender -c primdiffusion capture --people SCANS --out CAPTURES         captures from all sides, to train on
It has more options: see capture --help. Humans: primdiffusion generate, or examples/blender_batch.py."""
_handles: list[object] = []
"""Handles of the registered command."""


def execute(argv: Sequence[str]) -> int:
    """Run a command; returns its exit code."""
    if argv and argv[0] == "capture":
        return main(list(argv[1:]))
    asked = list(argv) in (["--help"], ["-h"])
    print(_HELP, file=sys.stdout if asked else sys.stderr, flush=True)
    return DONE if asked else UNUSABLE


def register() -> None:
    """Register the command with Blender."""
    _handles.append(bpy.utils.register_cli_command(COMMAND, execute))


def unregister() -> None:
    """Undo `register`."""
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
