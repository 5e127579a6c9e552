"""The sidebar panel Captures: render, verify, and a preview of the cameras."""

from __future__ import annotations

import contextlib
import shlex
import time

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from ..backend.requests import error_text
from ..capture.cameras import aim
from ..capture.command import ASK_FROM, describe, estimate, parse, scans_in, settings_of
from ..capture.job import run
from ..console import Report, report_path
from ..formats.camera_rig import bounding_sphere
from ..formats.capture_repair import repair, verify
from ..formats.regular_files import printable
from ..jobs.follow import Reporting, redraw
from ..places import shows_captures
from ..scene.blend_values import setting_path
from ..scene.convention import points_to_backend
from .captures_session import captures
from .captures_settings import words_of
from .drawing import DATA, SidebarPanel, draw_lines, draw_section, property_columns

RIG = "Capture Rig"
_TICK_S = 0.1
_PRINT_S = 1.0
"""Between lines of progress in background mode."""
_PERSON_M = 1.1
"""Radius of the sphere around a human in T pose at the world's origin, where nothing is selected."""


class PRIMDIFFUSION_OT_render_captures(bpy.types.Operator):
    """Render all people in the folder from all sides, into the folder of captures"""

    bl_idname = "primdiffusion.render_captures"
    bl_label = "Render Captures"
    bl_options: set[str] = set()  # neither REGISTER (redo) nor UNDO: the scene stays as it is

    people: bpy.props.StringProperty(name="People", description="Empty: the panel's")
    out: bpy.props.StringProperty(name="Captures", description="Empty: the panel's")
    options: bpy.props.StringProperty(name="Options", description="More words, as on the command line")

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask before a long run; errors are reported by `execute`."""
        try:
            options = parse(self._words(context))
            views, message = estimate(settings_of(options), len(scans_in(options.people, options.only)))
        except (OSError, ValueError, RuntimeError):
            return self.execute(context)
        if views < ASK_FROM:
            return self.execute(context)
        return context.window_manager.invoke_confirm(
            self, event, title="Render Captures?", message=message, confirm_text="Render"
        )

    def _words(self, context: bpy.types.Context) -> list[str]:
        asked = context.scene.primdiffusion_captures
        return words_of(asked, context, captures.new_folder(), self.people, self.out) + shlex.split(self.options)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """With a window another Blender renders and a timer follows it; in background mode this one renders."""
        try:
            if captures.busy:
                raise ValueError("captures are being rendered; wait for them or press Cancel")
            words = self._words(context)
            if bpy.app.background:
                return self._render_here(context, words)
            settings_of(parse(words))  # report impossible settings at once
            captures.start(words)
        except (OSError, ValueError, RuntimeError) as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        bpy.app.timers.register(follow, first_interval=_TICK_S, persistent=True)
        return {"FINISHED"}

    def _render_here(self, context: bpy.types.Context, words: list[str]) -> set[str]:
        options = parse(words)
        settings, report, printed = settings_of(options), Report(), 0.0
        captures.close()  # the file of cameras is read
        scans = scans_in(options.people, options.only)
        with contextlib.closing(run(context, settings, scans, report)) as steps:
            for progress in steps:
                for line in progress.news:
                    print(printable(f"PrimDiffusion: {line}"), flush=True)
                if time.monotonic() - printed > _PRINT_S:
                    printed = time.monotonic()
                    print(f"PrimDiffusion: {describe(progress)}", flush=True)
        if report.failed:
            first, path = report.failed[0], report_path(settings.out, settings.shard)
            who = first["subject"] or first["what"]
            self.report({"ERROR"}, f"{len(report.failed)} failed; {who}: {first['why']} (all: {path})")
            return {"CANCELLED"}
        return {"FINISHED"}


class PRIMDIFFUSION_OT_verify_captures(Reporting, bpy.types.Operator):
    """Read every file of the captures and report what is missing, truncated or altered"""

    bl_idname = "primdiffusion.verify_captures"
    bl_label = "Verify"

    out: bpy.props.StringProperty(name="Captures", description="Empty: the panel's")
    repair: bpy.props.BoolProperty(
        name="Repair", description="Remove damaged files, so that the next run renders only those again"
    )

    def act(self, context: bpy.types.Context) -> set[str]:
        """With a window another Blender verifies; in background mode this one, failing on damage."""
        out = bpy.path.abspath(self.out) or setting_path(context.scene.primdiffusion_captures.out, "Captures")
        if not out:
            raise ValueError("choose the folder of captures first")
        words = ["--out", out, "--verify", *(["--repair"] if self.repair else [])]
        if not bpy.app.background:
            captures.start(words)
            bpy.app.timers.register(follow, first_interval=_TICK_S, persistent=True)
            return {"FINISHED"}
        root = parse(words).out
        wrong = verify(root)
        for path, what in wrong.items():
            print(printable(f"PrimDiffusion: {path}: {what}"))
        if self.repair:
            repair(root, wrong)
        elif wrong:
            first, what = next(iter(wrong.items()))
            raise ValueError(f"{len(wrong)} problems; the first: {first}: {what}")
        return {"FINISHED"}


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


def follow() -> float | None:
    """The timer: process the child's output, redraw."""
    if captures.tick():
        redraw()
    return _TICK_S if captures.busy else None


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
            left = f" ({_minutes(captures.eta_s)} left)" if captures.eta_s else ""
            layout.progress(factor=captures.fraction, text=f"{captures.message}{left}", translate=False)
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
        (draw_section(layout, "captures_input", text="Input"), _draw_input),
        (draw_section(layout, "captures_poses", text="Poses"), _draw_poses),
        (draw_section(layout, "captures_cameras", text="Cameras"), _draw_cameras),
        (draw_section(layout, "captures_cycles", text="Cycles"), _draw_cycles),
        (draw_section(layout, "captures_output", text="Output"), _draw_output),
    )
    for body, content in sections:
        if body is None:
            continue
        if captures.busy:
            draw_lines(body, "Wait for the captures, or cancel them", "INFO")
        column = property_columns(body.column())
        column.enabled = not captures.busy
        content(column, asked, context)


def _draw_input(layout: bpy.types.UILayout, asked, _context) -> None:
    """Whose body, and which part of the people."""
    layout.prop(asked, "body")
    layout.prop(asked, "seed")
    row = layout.row(align=True)
    row.prop(asked, "shard")
    row.prop(asked, "shards")


def _draw_poses(layout: bpy.types.UILayout, asked, _context) -> None:
    """Which poses they take."""
    layout.prop(asked, "poses")
    layout.prop(asked, "pose_count")
    layout.prop(asked, "together")


def _draw_cameras(layout: bpy.types.UILayout, asked, context: bpy.types.Context) -> None:
    """Where the cameras stand."""
    layout.prop(asked, "arrangement")
    if asked.arrangement == "custom":
        layout.prop(asked, "cameras")
        if asked.cameras is None:
            layout.label(text="Without a collection: the selected cameras", icon="INFO")
        return
    layout.prop(asked, "camera_count")
    if asked.arrangement == "rings":
        for name in ("rings", "lowest", "highest"):
            layout.prop(asked, name)
    layout.prop(asked, "fov")
    layout.prop(asked, "margin")
    shown = RIG in context.scene.collection.children
    layout.operator(
        "primdiffusion.preview_rig", text="Hide Cameras" if shown else "Preview Cameras", icon="CAMERA_DATA"
    )


def _draw_cycles(layout: bpy.types.UILayout, asked, _context) -> None:
    """How Cycles renders."""
    layout.prop(asked, "samples")
    layout.prop(asked, "device")
    layout.prop(asked, "light")
    if asked.light == "hdri":
        layout.prop(asked, "hdri")
    if asked.light != "uniform":
        layout.prop(asked, "denoise")
        if asked.together > 1:
            layout.prop(asked, "shadows")


def _draw_output(layout: bpy.types.UILayout, asked, _context) -> None:
    """What is written."""
    for name in ("width", "height", "background"):
        layout.prop(asked, name)
    layout.column().prop(asked, "passes")
    layout.prop(asked, "float_depth")
    layout.column().prop(asked, "layouts")
    layout.prop(asked, "released_reference")
    row = layout.row(align=True)
    row.operator("primdiffusion.verify_captures", icon="CHECKMARK").repair = False
    row.operator("primdiffusion.verify_captures", text="Repair", icon="TOOL_SETTINGS").repair = True


def _minutes(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{seconds:.0f} s" if seconds < 90 else f"{minutes} min" if minutes < 120 else f"{minutes / 60:.1f} h"


def unregister() -> None:
    """End the child and the timer."""
    captures.close()
    if bpy.app.timers.is_registered(follow):
        bpy.app.timers.unregister(follow)
