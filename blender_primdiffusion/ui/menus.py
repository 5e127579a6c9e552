"""Blender's own menus, and with them its search (F3): Add > Human, File > Import and Export; Viewport Overlays;
the status bar."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..jobs.queue import queue
from ..places import EXTENSION, backend_is_named
from ..scene.human import any_humans
from .drawing import draw_progress
from .preferences import known

_IMPORT, _EXPORT = "PrimDiffusion Human (.human)", "PrimDiffusion Human (.human, .glb, .ply)"
_STATUS_UNITS = 15
"""Width of the running job in the status bar."""
FOLDER = Path(__file__).resolve().parents[1] / "gallery"


def draw_samples(layout: bpy.types.UILayout) -> None:
    """A button for each human that comes with the extension, which needs no backend."""
    for path in sorted(FOLDER.glob("*.human")):
        text = "Add Sample Human" if path.stem == "Sample" else f"Add {path.stem}"
        layout.operator("primdiffusion.import_human", text=text, icon="COMMUNITY").filepath = str(path)


class PRIMDIFFUSION_MT_add(bpy.types.Menu):
    """Ways to add a human."""

    bl_label = "Human"

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        layout.operator_context = "INVOKE_DEFAULT"
        if backend_is_named() and known().usable:
            layout.operator("primdiffusion.generate", icon="OUTLINER_OB_ARMATURE")
            layout.operator("primdiffusion.choose_picture", text="Human from Picture...", icon="IMAGE_DATA")
        elif backend_is_named():
            text = "Generate Human: Set Up Backend..."
            layout.operator("preferences.addon_show", text=text, icon="PREFERENCES").module = EXTENSION
        draw_samples(layout)
        layout.operator("primdiffusion.import_human", text="Import Human File...", icon="IMPORT")


def draw_add(menu: bpy.types.Menu, _context: bpy.types.Context) -> None:
    """Draw the entry of Add."""
    menu.layout.menu("PRIMDIFFUSION_MT_add", icon="OUTLINER_OB_ARMATURE")


def draw_import(menu: bpy.types.Menu, _context: bpy.types.Context) -> None:
    """Draw the entry of File > Import."""
    menu.layout.operator("primdiffusion.import_human", text=_IMPORT)


def draw_export(menu: bpy.types.Menu, _context: bpy.types.Context) -> None:
    """Draw the entry of File > Export."""
    menu.layout.operator("primdiffusion.export", text=_EXPORT)


def draw_switch(menu: bpy.types.Panel, context: bpy.types.Context) -> None:
    """In the popover Viewport Overlays: whether views show humans."""
    if any_humans():
        column = menu.layout.column()
        column.label(text="PrimDiffusion", translate=False)
        column.prop(context.scene.primdiffusion_render, "in_viewports")


def draw_status(header: bpy.types.Header, _context: bpy.types.Context) -> None:
    """In the status bar: the running job."""
    if queue.current is not None:
        row = header.layout.row()
        row.ui_units_x = _STATUS_UNITS
        draw_progress(row)


_ENTRIES = (
    ("VIEW3D_MT_add", draw_add),
    ("TOPBAR_MT_file_import", draw_import),
    ("TOPBAR_MT_file_export", draw_export),
    ("VIEW3D_PT_overlay", draw_switch),
    ("STATUSBAR_HT_header", draw_status),
)


def register() -> None:
    """Add the entries to Blender's menus."""
    for menu, entry in _ENTRIES:
        getattr(bpy.types, menu).append(entry)


def unregister() -> None:
    """Undo `register`."""
    for menu, entry in _ENTRIES:
        getattr(bpy.types, menu).remove(entry)
