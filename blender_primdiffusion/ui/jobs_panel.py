"""The sidebar panel Jobs, shown while there are any; the backend: device, memory, diagnostics."""

from __future__ import annotations

import os
import platform
import tomllib
from collections.abc import Iterator
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ..backend.requests import error_text
from ..jobs import follow, memory
from ..jobs.follow import Reporting, redraw, submit
from ..jobs.memory import device_line
from ..jobs.pictures import so_far
from ..jobs.queue import queue
from ..places import EXTENSION
from .captures_session import captures
from .declared import SKIP
from .drawing import SidebarPanel, draw_ended, draw_lines, draw_queue
from .preferences import being_set_up, cancel_set_up

TEXT = "PrimDiffusion Diagnostics"
_LOG_LINES = 40


def diagnostics() -> str:
    """Versions, device, and the last job with its error and the end of the child's log; the home folder is "~"."""
    return "\n".join(_lines()).replace(str(Path.home()), "~")


def _lines() -> Iterator[str]:
    info, outcome = queue.info, queue.last
    yield f"PrimDiffusion {_version()} ({'extension' if EXTENSION.startswith('bl_ext.') else 'from source'})"
    yield f"Blender {bpy.app.version_string} ({bpy.app.build_hash.decode(errors='replace')})"
    yield f"System {platform.platform()}, {platform.machine()}, {os.cpu_count()} processors"
    python, torch = info.get("python", "?"), info.get("torch", "?")
    yield f"Backend {info.get('version', 'not started yet')}, Python {python}, torch {torch}"
    yield f"Device {device_line()}"
    if outcome is None:
        return
    spent = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in outcome.seconds.items())
    yield f"Last job: {outcome.entry.job.label} ({outcome.entry.job.method}) {spent}"
    if outcome.error is None:
        yield f"Ended: {outcome.notice}"
        return
    yield f"Error ({outcome.error.kind}): {outcome.sentence}"
    yield from (f"    {line}" for line in (outcome.error.log or queue.log)[-_LOG_LINES:])


def _version() -> str:
    manifest = Path(__file__).resolve().parents[1] / "blender_manifest.toml"
    try:
        with open(manifest, "rb") as file:
            return tomllib.load(file)["version"]
    except (OSError, ValueError, KeyError):
        return "of unknown version"


class PRIMDIFFUSION_OT_copy_diagnostics(bpy.types.Operator):
    """Copy what a bug report needs: versions, device, the last error and its log, which may name your files"""

    bl_idname = "primdiffusion.copy_diagnostics"
    bl_label = "Copy Diagnostics"
    bl_options: set[str] = set()

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Without a window there is no clipboard: a text block holds the diagnostics instead."""
        text = diagnostics()
        if bpy.app.background:
            block = bpy.data.texts.get(TEXT) or bpy.data.texts.new(TEXT)
            block.from_string(text)
            self.report({"INFO"}, f"the text {TEXT!r} holds them")
        else:
            context.window_manager.clipboard = text
            self.report({"INFO"}, "copied: read it before you paste it into a report")
        return {"FINISHED"}


class PRIMDIFFUSION_OT_cancel(Reporting, bpy.types.Operator):
    """Stop this job, or remove it from the queue; nothing is added to the scene"""

    bl_idname = "primdiffusion.cancel"
    bl_label = "Cancel"
    described_by = ("what",)

    what: bpy.props.EnumProperty(
        name="Cancel",
        description="What to stop",
        items=[
            ("JOB", "Job", "Stop this job, or remove it from the queue; nothing is added to the scene"),
            ("CAPTURES", "Captures", "Stop rendering; finished pictures stay, and the next run resumes from them"),
            ("SET_UP", "Set-Up", "Stop; the next Set Up Backend uses what was downloaded"),
        ],
        options=SKIP,
    )
    number: bpy.props.IntProperty(
        name="Number", description="Number of the queued job; 0 is the running one", min=0, options=SKIP
    )

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        busy = queue.busy or captures.busy or being_set_up()
        if not busy:
            cls.poll_message_set("Nothing is running: no job, no captures, no set-up")
        return busy

    def act(self, _context: bpy.types.Context) -> set[str]:
        if self.what == "CAPTURES":
            if not captures.busy:
                raise ValueError("no captures are being rendered")
            captures.cancel()
        elif self.what == "SET_UP":
            cancel_set_up()
        elif not queue.cancel(self.number):
            which = f"job {self.number} is no longer queued" if self.number else "no job is running yet"
            raise ValueError(which)
        redraw()
        return {"FINISHED"}


class PRIMDIFFUSION_OT_try_again(Reporting, bpy.types.Operator):
    """Queue the failed job again"""

    bl_idname = "primdiffusion.try_again"
    bl_label = "Try Again"

    kind: bpy.props.StringProperty(
        name="Kind", description="Kind of job, such as generate; empty: the last one that ended", options=SKIP
    )

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        failed = any(outcome.error is not None for outcome in queue.outcomes.values())
        if not failed:
            cls.poll_message_set("No job has failed")
        return failed

    def act(self, context: bpy.types.Context) -> set[str]:
        outcome = queue.outcomes.get(self.kind) if self.kind else queue.last
        if outcome is None or outcome.error is None:
            why = f"no job {self.kind!r} has failed" if self.kind else "the last job did not fail"
            raise ValueError(why)
        return submit(self, context, outcome.entry.job)


class PRIMDIFFUSION_OT_release_memory(bpy.types.Operator):
    """End the processes that generate and draw, to release their memory; they restart when needed"""

    bl_idname = "primdiffusion.release_memory"
    bl_label = "Release Memory"
    bl_options: set[str] = set()

    def execute(self, _context: bpy.types.Context) -> set[str]:
        try:
            freed = memory.release()
        except RuntimeError as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        self.report({"INFO"}, freed)
        redraw()
        return {"FINISHED"}


class PRIMDIFFUSION_PT_jobs(SidebarPanel, bpy.types.Panel):
    """Queued jobs, and those that ended before. Progress is shown below the button that started the job."""

    bl_label = "Jobs"
    bl_order = 5

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        return queue.busy

    def draw(self, _context: bpy.types.Context) -> None:
        draw_queue(self.layout)
        draw_ended(self.layout)


def draw_backend(layout: bpy.types.UILayout) -> None:
    """What computes, and what to do when it does not."""
    draw_lines(layout, f"Device: {device_line()}", "MEMORY")
    column = layout.column(align=True)
    column.operator("primdiffusion.release_memory", icon="TRASH")
    column.operator("primdiffusion.copy_diagnostics", icon="COPYDOWN")


@persistent
def drop_before_loading(*_: object) -> None:
    """Handler of load_pre: the results of jobs belong into the file that is being closed."""
    queue.drop()
    so_far.show(None)


@persistent
def watch_after_loading(*_: object) -> None:
    """Handler of load_post, and of a load that failed: the timers start again."""
    follow.keep_watching()


HANDLERS = (
    ("load_pre", drop_before_loading),
    ("load_post", watch_after_loading),
    ("load_post_fail", watch_after_loading),
)


def register() -> None:
    """Notice a child that dies between jobs; in background mode no timer runs."""
    if not bpy.app.background:
        follow.keep_watching()


def unregister() -> None:
    """End the child and the timers."""
    queue.close()
    so_far.close()
    for timer in (follow.follow, follow.watch):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
