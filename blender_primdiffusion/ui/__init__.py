"""What the user sees and presses: a room for each subject, each with its settings, operators and panels."""

from __future__ import annotations

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
    """All rooms."""
    for room in ROOMS:
        room.register()


def unregister() -> None:
    """All of `register` undone, the children ended."""
    for room in reversed(ROOMS):
        room.unregister()
