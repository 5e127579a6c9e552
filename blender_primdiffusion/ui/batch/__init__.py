"""People and pictures without a window: `blender -c primdiffusion ...`."""

from __future__ import annotations

from . import command

_commands: list[object] = []
"""Of Blender's command line, while they are known to it."""


def register() -> None:
    """Make the command known to Blender."""
    _commands.append(command.register())


def unregister() -> None:
    """Undo `register`."""
    while _commands:
        command.unregister(_commands.pop())
