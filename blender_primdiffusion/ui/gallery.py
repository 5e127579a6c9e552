"""Add Sample Human: the humans that come with the extension, which need no backend."""

from __future__ import annotations

import functools
from pathlib import Path

import bpy

FOLDER = Path(__file__).resolve().parents[1] / "gallery"


@functools.cache
def samples() -> list[Path]:
    """The humans in the gallery; none in builds without."""
    return sorted(FOLDER.glob("*.human"))


class PRIMDIFFUSION_MT_samples(bpy.types.Menu):
    """Add a human that comes with the extension"""

    bl_label = "Add Sample Human"

    def draw(self, _context: bpy.types.Context) -> None:
        for path in samples():
            draw_sample(self.layout, path, path.stem.replace("_", " "))


def draw_sample(layout: bpy.types.UILayout, path: Path, text: str) -> None:
    """The button that adds one."""
    layout.operator("primdiffusion.import_human", text=text, icon="COMMUNITY").filepath = str(path)


def draw_samples(layout: bpy.types.UILayout) -> None:
    """The button, or a menu of several."""
    if len(samples()) > 1:
        layout.menu("PRIMDIFFUSION_MT_samples", icon="COMMUNITY")
    elif samples():
        draw_sample(layout, samples()[0], PRIMDIFFUSION_MT_samples.bl_label)
