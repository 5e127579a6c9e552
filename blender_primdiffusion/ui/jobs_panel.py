"""The sidebar panel Jobs, shown while there are any; the backend: device, memory, diagnostics."""

from __future__ import annotations

import contextlib
import getpass
import os
import platform
import re
import tomllib
from collections.abc import Iterable, Iterator

import bpy
from bpy.app.handlers import persistent

from ..backend.requests import error_text
from ..jobs import follow, memory
from ..jobs.follow import Reporting, redraw, submit
from ..jobs.memory import device_line
from ..jobs.pictures import so_far
from ..jobs.queue import queue
from ..places import EXTENSION, backend_module_path, preference
from .captures_session import captures
from .declared import SKIP
from .drawing import SidebarPanel, draw_ended, draw_lines, draw_queue
from .preferences import being_set_up, cancel_set_up

TEXT = "PrimDiffusion Diagnostics"
_LOG_LINES = 60
_PATHS = ("backend_python", "checkpoint", "encoder")
_KNOWN = re.compile(
    r"(?:blender_primdiffusion|primdiffusion|site-packages|dist-packages|python3\.\d+|scripts[/\\]+(?:modules|addons_core))"
    r"[/\\].*",
    re.DOTALL,
)
"""From these folders on, a path belongs to a program and is not private."""
_SLASH = r"(?:/|\\{1,8}|%2[Ff]|%5[Cc])"
_DRIVE = rf"(?:file:/{{2,3}})?[A-Za-z](?::|%3[Aa]){_SLASH}"
_SHARE = r"(?:file:/*)?(?:\\{2,8}|(?:%5[Cc]){2,8})(?=[^\s\\])"
_ROOT = r"(?:file:)?(?:/|%2[Ff])+(?=[^\s/])"
_START = rf"(?:{_DRIVE}|{_SHARE}|{_ROOT})"
"""C:\\, UNC, /, file://; as they are, in JSON and percent-encoded."""
_PART = r"[^\s\"'<>|*?:,;()\[\]{}/\\%]|%(?!2[Ff]|5[Cc])"
_WORD = rf"(?:{_PART})+"
_FOLDER = rf"{_WORD}(?: {_WORD})*{_SLASH}"
_FILE = rf"(?:{_WORD}(?: {_WORD}){{0,5}}?\.[A-Za-z][A-Za-z0-9]{{0,12}}(?![A-Za-z0-9.])|{_WORD})?"
_PATH = re.compile(rf"(?<![A-Za-z0-9_.<>~/\\%]){_START}(?:{_FOLDER})*{_FILE}")
_QUOTED = re.compile(rf"(?P<quote>[\"'])(?P<path>{_START}[^\"'\n]*)(?P=quote)")
_SUFFIX = re.compile(r"\.[A-Za-z][A-Za-z0-9]{0,12}$")


def diagnostics() -> str:
    """Versions, device, memory, the last job, its error and the end of the child's log; redacted."""
    return redact("\n".join(_lines()), _names())


def redact(text: str, names: Iterable[str] = ()) -> str:
    """`text` with absolute paths as <path>, and each of `names` (of the user, of the machine) as <name>.

    A file's ending stays, and so does what lies below a program's folder: <path>/site-packages/torch/nn.py. Paths are
    found also with blanks, in JSON, percent-encoded, on Windows and on shares. Too much may go, too little must not.
    """
    text = _QUOTED.sub(lambda found: f"{found['quote']}{_short(found['path'])}{found['quote']}", text)
    text = _PATH.sub(lambda found: _short(found[0]), text)
    for name in sorted({name for name in names if len(name) > 1}, key=len, reverse=True):
        text = re.sub(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])", "<name>", text, flags=re.IGNORECASE)
    return text


def _short(path: str) -> str:
    if not re.search(r"[^/\\%]", path):
        return path
    if known := _KNOWN.search(path):
        return f"<path>/{known[0]}"
    ending = _SUFFIX.search(path)
    return f"<path>{ending[0] if ending else ''}"


def _lines() -> Iterator[str]:
    info = queue.info
    yield f"PrimDiffusion {_version()} ({'extension' if EXTENSION.startswith('bl_ext.') else 'from source'})"
    yield f"Blender {bpy.app.version_string} ({bpy.app.build_hash.decode(errors='replace')}), {_window()}"
    yield f"System {platform.platform()}, {platform.machine()}, {os.cpu_count()} processors"
    python, torch = info.get("python", "?"), info.get("torch", "?")
    yield f"Backend {info.get('version', 'not started yet')}, Python {python}, torch {torch}"
    yield f"Backend found: {'yes' if backend_module_path() else 'no'}"
    yield "Set in the preferences: " + (", ".join(filter(preference, _PATHS)) or "nothing")
    yield f"Device {device_line()}"
    yield f"Memory {info.get('memory_gb', '?')} GB, {info.get('memory_free_gb', '?')} GB free at the backend's start"
    yield f"Child running: {queue.child_pid is not None}; queued: {len(queue.waiting)}"
    if queue.current is not None:
        yield f"Running: {queue.current.job.label}: {queue.request.state}, {queue.request.message}"
    if (outcome := queue.last) is not None:
        spent = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in outcome.seconds.items())
        yield f"Last job: {outcome.entry.job.label} ({outcome.entry.job.method}) {spent}"
        yield f"Ended: {outcome.notice or 'with an error'}"
        if outcome.error is not None:
            yield f"Error ({outcome.error.kind}): {outcome.sentence}"
    error = queue.last.error if queue.last is not None else None
    log = error.log if error is not None and error.log else queue.log
    yield f"Log, the last {min(len(log), _LOG_LINES)} lines:"
    yield from (f"    {line}" for line in log[-_LOG_LINES:])


def _version() -> str:
    manifest = os.path.join(os.path.dirname(os.path.dirname(__file__)), "blender_manifest.toml")
    try:
        with open(manifest, "rb") as file:
            return tomllib.load(file)["version"]
    except (OSError, ValueError, KeyError):
        return "of unknown version"


def _window() -> str:
    return "no window" if bpy.app.background else "with a window"


def _names() -> set[str]:
    """Names of the user, the home folder and the machine."""
    home = os.path.basename(os.path.expanduser("~"))
    names = {home, os.environ.get("USER", ""), os.environ.get("USERNAME", ""), platform.node()}
    with contextlib.suppress(OSError, KeyError, ImportError):  # no such user on this system (containers)
        names.add(getpass.getuser())
    return names


class PRIMDIFFUSION_OT_copy_diagnostics(bpy.types.Operator):
    """Copy what a bug report needs: versions, device, last error and log, without user names or folder names"""

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
