"""What the user sees and presses: a room for each subject, each with its settings, operators and panels."""

from __future__ import annotations

import bpy

from ..scene.collect import collect_before_saving
from . import (
    assets,
    batch,
    captures,
    export,
    files,
    generate,
    human,
    jobs,
    manual,
    motion,
    render,
    setup,
    translations,
    variations,
)

ROOMS = (
    translations, setup, jobs, generate, variations, human, files, motion, assets, render,
    captures, export, batch, manual,
)  # fmt: skip
"""In the order of registration: later ones refer to settings and parent panels of earlier ones."""


def register() -> None:
    """All rooms and handlers."""
    for room in ROOMS:
        room.register()
    bpy.app.handlers.save_pre.append(collect_before_saving)


def unregister() -> None:
    """All of `register` undone, the children ended."""
    if collect_before_saving in bpy.app.handlers.save_pre:  # 5.2 clears them before it disables extensions at exit
        bpy.app.handlers.save_pre.remove(collect_before_saving)
    for room in reversed(ROOMS):
        room.unregister()
