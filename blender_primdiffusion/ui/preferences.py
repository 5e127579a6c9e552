"""Preferences that every build has."""

from __future__ import annotations

import bpy

from ..jobs.follow import redraw
from ..jobs.queue import queue
from ..places import EXTENSION
from .drawing import DATA

WIDTH = 90
"""Characters in a line of the preferences window at its default size."""
NOTHING_TO_CANCEL = "nothing is being set up"


def _redraw(_preferences: bpy.types.AddonPreferences, _context: bpy.types.Context) -> None:
    redraw()


def forget_failures() -> None:
    """Forget how jobs failed for want of a backend: another one was chosen."""
    for kind, outcome in list(queue.outcomes.items()):
        if outcome.error is not None and outcome.error.kind in {"environment", "timeout"}:
            del queue.outcomes[kind]


class CommonPreferences:
    """Base of the preferences, which declare `backend_python` too; `bpy.types.AddonPreferences` is their other base."""

    bl_idname = EXTENSION

    checkpoint: bpy.props.StringProperty(
        name="Checkpoint",
        description="Diffusion model, a .safetensors file; empty: the bundled one",
        subtype="FILE_PATH",
    )
    encoder: bpy.props.StringProperty(
        name="Encoder",
        description="Encoder for humans from captures, a .safetensors file; empty: the bundled one",
        subtype="FILE_PATH",
    )
    idle_minutes: bpy.props.IntProperty(
        name="Release Memory After",
        description="Minutes after the last job until the backend releases its memory, including the graphics card's; "
        "0: never",
        default=10,
        min=0,
        soft_max=120,
    )

    captures: bpy.props.BoolProperty(
        name="Captures",
        description=f"Show the tab {DATA} in the sidebar: training data from scans, and humans from images",
        update=_redraw,
    )

    def draw_properties(self, layout: bpy.types.UILayout) -> None:
        """All properties that need no more than a field."""
        layout.use_property_split = True
        layout.use_property_decorate = False
        for name in ("backend_python", "checkpoint", "encoder", "idle_minutes", "captures"):
            layout.prop(self, name)
