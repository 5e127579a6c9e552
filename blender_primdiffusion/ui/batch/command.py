"""`blender -c primdiffusion capture ...`."""

from __future__ import annotations

import sys

import bpy

COMMAND = "primdiffusion"


def execute(argv: list[str]) -> int:
    """The extension's command line; returns the exit code."""
    if argv[:1] != ["capture"]:
        print("blender -c primdiffusion capture --people FOLDER --out FOLDER ...; --help tells more", file=sys.stderr)
        return 2
    from ...capture.command import main

    return main(argv[1:])


def register() -> object:
    """Make the command known; returns what `unregister` needs."""
    return bpy.utils.register_cli_command(COMMAND, execute)


def unregister(command: object) -> None:
    """Undo `register`."""
    bpy.utils.unregister_cli_command(command)
