"""The panel Human from Captures."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import bpy

from ..formats.capture_layout import LIST_FILE, read_list
from ..formats.requests import ReconstructRequest
from ..jobs.follow import Reporting, submit
from ..jobs.generate import ReconstructJob
from ..scene.blend_values import setting_path
from .captures_panel import DataPanel
from .declared import declared
from .drawing import draw_job, property_columns

_CAMERAS_FILE = "cameras.json"
_BY = (
    ("encoder", "Encoder", "A network turns several views into a human within seconds"),
    ("prior", "Prior", "The human is fitted to the views, and what they do not show is guessed: one view is enough"),
)


def subjects_in(folder: Path) -> list[str]:
    """Names of the humans in a dataset of captures; none where the folder is one subject's own, or cannot be read."""
    try:
        if (folder / _CAMERAS_FILE).is_file():
            return []
        if (folder / LIST_FILE).is_file():
            return sorted(set(read_list(folder)))
        return sorted(path.parent.name for path in folder.glob(f"*/{_CAMERAS_FILE}"))
    except (OSError, ValueError):
        return []


def _search(self: PRIMDIFFUSION_PG_reconstruct, _context: bpy.types.Context, typed: str) -> Iterator[str]:
    try:
        folder = setting_path(self.capture, "Captures")
    except ValueError:  # the operator reports it
        return
    if folder:
        names = subjects_in(Path(folder))
        yield from (name for name in names if typed.lower() in name.lower())


class PRIMDIFFUSION_PG_reconstruct(bpy.types.PropertyGroup):
    """`scene.primdiffusion_reconstruct`."""

    capture: bpy.props.StringProperty(
        name="Captures",
        description="Folder of a dataset of captures, or of one subject in it",
        subtype="DIR_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE"},
    )
    subject: bpy.props.StringProperty(
        name="Subject", description="Subject of the dataset; empty if there is only one", search=_search
    )
    frame: declared(ReconstructRequest, "frame")
    views: declared(ReconstructRequest, "views")
    by: bpy.props.EnumProperty(name="By", description="How the views become a human", items=_BY)


class PRIMDIFFUSION_OT_human_from_captures(Reporting, bpy.types.Operator):
    """Reconstruct a human from pictures taken from several sides, and add it to the scene with an armature"""

    bl_idname = "primdiffusion.human_from_captures"
    bl_label = "Human from Captures"

    def act(self, context: bpy.types.Context) -> set[str]:
        asked = context.scene.primdiffusion_reconstruct
        folder = setting_path(asked.capture, "Captures")
        if not folder:
            raise ValueError("choose the folder of captures first")
        if not os.path.isdir(folder):
            raise FileNotFoundError(f"there is no folder {folder!r:.200}: choose one of captures")
        return submit(self, context, ReconstructJob(folder, asked.subject, asked.frame, asked.views, asked.by))


class PRIMDIFFUSION_PT_human_from_captures(DataPanel, bpy.types.Panel):
    """Capture, subject, frame, views and the button; progress and errors."""

    bl_label = "Human from Captures"
    bl_order = 11
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout, asked = property_columns(self.layout), context.scene.primdiffusion_reconstruct
        column = layout.column()
        for name in ("capture", "subject", "frame", "views", "by"):
            column.prop(asked, name)
        draw_job(layout, "reconstruct", "primdiffusion.human_from_captures", "OUTLINER_OB_ARMATURE")


PROPERTIES = (
    (bpy.types.Scene, "primdiffusion_reconstruct", bpy.props.PointerProperty(type=PRIMDIFFUSION_PG_reconstruct)),
)
