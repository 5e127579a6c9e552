"""The sidebar panel Captures: render, and a preview of the cameras; and the extension's command line,
`blender -c primdiffusion capture ...`."""

from __future__ import annotations

import shlex
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from ..capture.cameras import aim
from ..capture.command import main, parse, settings_of
from ..console import DONE, UNUSABLE
from ..formats.camera_rig import bounding_sphere
from ..jobs.follow import Reporting
from ..places import shows_captures
from ..scene.convention import points_to_backend
from .captures_settings import captures, capturing, command_args
from .drawing import DATA, SidebarPanel, draw_lines, draw_section, property_columns

RIG = "Capture Rig"
_PERSON_M = 1.1
"""Radius of the sphere around a human in T pose at the world's origin, where nothing is selected."""


class PRIMDIFFUSION_OT_render_captures(Reporting, bpy.types.Operator):
    """Render all people in the folder from all sides, into the folder of captures"""

    bl_idname = "primdiffusion.render_captures"
    bl_label = "Render Captures"

    options: bpy.props.StringProperty(name="Options", description="More words, as on the command line")

    def act(self, context: bpy.types.Context) -> set[str]:
        """Another Blender renders; a timer follows it, or in background mode this waits."""
        settings = context.scene.primdiffusion_captures
        folder = _temporary_folder()
        args = command_args(settings, context, folder) + shlex.split(self.options)
        settings_of(parse(args))  # report impossible settings at once
        captures.start(capturing(args, folder))
        return captures.follow(self)


class PRIMDIFFUSION_OT_preview_rig(Reporting, bpy.types.Operator):
    """Show the cameras around the active object, or hide them again"""

    bl_idname = "primdiffusion.preview_rig"
    bl_label = "Preview Cameras"
    bl_options = {"UNDO"}

    def act(self, context: bpy.types.Context) -> set[str]:
        collection = context.scene.collection.children.get(RIG)
        if collection is not None:
            remove_rig(collection)
            return {"FINISHED"}
        rig = context.scene.primdiffusion_captures.rig()
        collection = bpy.data.collections.new(RIG)
        context.scene.collection.children.link(collection)
        for number, view in enumerate(rig.views(*_sphere_around(context))):
            camera = bpy.data.objects.new(f"Capture {number:04d}", bpy.data.cameras.new(f"Capture {number:04d}"))
            collection.objects.link(camera)
            aim(camera, view)
            camera.data.display_size = 0.1
            camera.hide_select = True
        return {"FINISHED"}


def remove_rig(collection: bpy.types.Object) -> None:
    """Remove the preview, but no objects that the user has added to its collection."""
    ours = [obj for obj in collection.objects if obj.type == "CAMERA" and obj.name.startswith("Capture ")]
    cameras = [obj.data for obj in ours]
    bpy.data.batch_remove([*ours, *cameras, collection])


def _temporary_folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="primdiffusion_captures_", dir=bpy.app.tempdir or None))


def _sphere_around(context: bpy.types.Context) -> tuple[NDArray[np.float64], float]:
    """Bounding sphere of the active object and its children, else of a human at the origin."""
    active = context.active_object
    objects = [active, *active.children_recursive] if active is not None and active.type != "CAMERA" else []
    depsgraph = context.evaluated_depsgraph_get()
    corners = [
        obj.matrix_world @ corner
        for obj in (obj.evaluated_get(depsgraph) for obj in objects)
        for corner in map(Vector, obj.bound_box)
        if obj.type in ("MESH", "ARMATURE")
    ]
    if not corners:
        return np.zeros(3), _PERSON_M
    centre, radius = bounding_sphere(points_to_backend(np.array(corners)))
    return (centre, radius) if radius > 0 else (centre, _PERSON_M)


_SHOWN_LINES = 4
_OUTPUT = ("width", "height", "background", "passes", "float_depth", "released_reference")


class DataPanel(SidebarPanel):
    """A panel in the tab of captures, which the preferences show."""

    bl_category = DATA

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return shows_captures()


class PRIMDIFFUSION_PT_captures(DataPanel, bpy.types.Panel):
    """From where to where, the button, how far it is, and all settings."""

    bl_label = "Captures"
    bl_order = 10
    manual_page = "captures"

    def draw(self, context: bpy.types.Context) -> None:
        layout, asked = property_columns(self.layout), context.scene.primdiffusion_captures
        column = layout.column()
        column.enabled = not captures.busy
        column.prop(asked, "people")
        column.prop(asked, "out")
        if captures.busy:
            layout.progress(factor=captures.fraction, text=captures.message, translate=False)
            layout.operator("primdiffusion.cancel", icon="CANCEL").what = "CAPTURES"
        else:
            layout.operator("primdiffusion.render_captures", icon="RENDER_ANIMATION")
        for text, icon in ((captures.error, "ERROR"), (captures.notice, "INFO")):
            draw_lines(layout, text, icon)
        if captures.busy or captures.error:
            for text in list(captures.lines)[-_SHOWN_LINES:]:
                draw_lines(layout, text, "DOT")
        _draw_settings(layout, asked, context)


def _draw_settings(layout: bpy.types.UILayout, asked, context: bpy.types.Context) -> None:
    """Sections of settings, which cannot be changed while captures are rendered."""
    sections = (
        ("Input", ("body", "seed", "shard", "shards"), None),
        ("Poses", ("poses", "pose_count", "together"), None),
        ("Cameras", _cameras(asked), _draw_preview),
        ("Cycles", _cycles(asked), None),
        ("Output", _OUTPUT, None),
    )
    for text, names, more in sections:
        body = draw_section(layout, f"captures_{text.lower()}", text=text)
        if body is None:
            continue
        if captures.busy:
            draw_lines(body, "Wait for the captures, or cancel them", "INFO")
        column = property_columns(body.column())
        column.enabled = not captures.busy
        for name in names:
            column.column().prop(asked, name)  # flags are one below the other
        if more is not None:
            more(column, asked, context)


def _cameras(asked) -> tuple[str, ...]:
    if asked.arrangement == "custom":
        return "arrangement", "cameras"
    rings = ("rings", "lowest", "highest") if asked.arrangement == "rings" else ()
    return ("arrangement", "camera_count", *rings, "fov", "margin")


def _cycles(asked) -> tuple[str, ...]:
    hdri = ("hdri",) if asked.light == "hdri" else ()
    shaded = () if asked.light == "uniform" else ("denoise", "shadows") if asked.together > 1 else ("denoise",)
    return ("samples", "device", "light", *hdri, *shaded)


def _draw_preview(layout: bpy.types.UILayout, asked, context: bpy.types.Context) -> None:
    if asked.arrangement != "custom":
        text = "Hide Cameras" if RIG in context.scene.collection.children else "Preview Cameras"
        layout.operator("primdiffusion.preview_rig", text=text, icon="CAMERA_DATA")
    elif asked.cameras is None:
        layout.label(text="Without a collection: the selected cameras", icon="INFO")


COMMAND = "primdiffusion"
_HELP = """\
blender -c primdiffusion capture --people SCANS --out CAPTURES         captures from all sides, to train on
It has more options: see capture --help. Humans: primdiffusion generate, or examples/blender_batch.py."""
_handles: list[object] = []
"""Handles of the registered command."""


def execute(argv: Sequence[str]) -> int:
    """Run a command; returns its exit code."""
    if argv and argv[0] == "capture":
        return main(list(argv[1:]))
    asked = list(argv) in (["--help"], ["-h"])
    print(_HELP, file=sys.stdout if asked else sys.stderr, flush=True)
    return DONE if asked else UNUSABLE


def register() -> None:
    """Register the command with Blender."""
    _handles.append(bpy.utils.register_cli_command(COMMAND, execute))


def unregister() -> None:
    """End the running capture, and the command."""
    captures.close()
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
