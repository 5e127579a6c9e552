"""`blender -c primdiffusion generate | render | capture ...`, and `python -m blender_primdiffusion ...`."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import bpy

from ...console import DONE, UNUSABLE

COMMAND = "primdiffusion"
_HELP = """\
blender -c primdiffusion generate --count 50 --seed 7 --out PEOPLE     people in folders
blender -c primdiffusion render PEOPLE --out PICTURES                  pictures of them, or of a .blend
blender -c primdiffusion capture --people SCANS --out CAPTURES         captures from all sides, to train on
Each tells more with --help.
Exit codes: 0 all is done, 1 some failed, 2 usage error, 3 no Python runs the backend, 130 stopped by Ctrl-C."""


def execute(argv: Sequence[str]) -> int:
    """The extension's command line; returns the exit code."""
    command, words = argv[:1], list(argv[1:])
    if command == ["generate"]:
        from .generate import main
    elif command == ["render"]:
        from .render import main
    elif command == ["capture"]:
        from ...capture.command import main
    else:
        asked = command in (["--help"], ["-h"])
        print(_HELP, file=sys.stdout if asked else sys.stderr, flush=True)
        return DONE if asked else UNUSABLE
    return main(words)


def register() -> object:
    """Make the command known; returns what `unregister` needs."""
    return bpy.utils.register_cli_command(COMMAND, execute)


def unregister(command: object) -> None:
    """Undo `register`."""
    bpy.utils.unregister_cli_command(command)
