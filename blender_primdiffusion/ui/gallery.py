"""Add Sample Human: the humans that come with the extension, which need no backend."""

from __future__ import annotations

import functools
from pathlib import Path

import bpy

from ..jobs.export import ImportHumanJob
from ..jobs.follow import Reporting, submit

FOLDER = Path(__file__).resolve().parents[1] / "gallery"


@functools.cache
def items() -> list[tuple[str, str, str]]:
    """The humans in the gallery by name, as items of an enum; empty in builds without."""
    return [(path.name, path.stem.replace("_", " "), "") for path in sorted(FOLDER.glob("*.human"))]


def _items(_operator: bpy.types.Operator, _context: bpy.types.Context | None) -> list[tuple[str, str, str]]:
    return items()


class PRIMDIFFUSION_OT_add_from_gallery(Reporting, bpy.types.Operator):
    """Add a human that comes with the extension, at the 3D cursor; its data are in the public domain (CC0)"""

    bl_idname = "primdiffusion.add_from_gallery"
    bl_label = "Add Sample Human"

    human: bpy.props.EnumProperty(
        name="Human", description="Which human of the gallery", items=_items, options={"SKIP_SAVE"}
    )

    def act(self, context: bpy.types.Context) -> set[str]:
        if not self.human:
            raise ValueError("this build of the extension has no gallery: choose Import Human File")
        return submit(self, context, ImportHumanJob(str(FOLDER / self.human)))


def draw_samples(layout: bpy.types.UILayout) -> None:
    """The button, or a menu of several."""
    if len(items()) > 1:
        layout.operator_menu_enum("primdiffusion.add_from_gallery", "human", icon="COMMUNITY")
    elif items():
        layout.operator("primdiffusion.add_from_gallery", icon="COMMUNITY").human = items()[0][0]
