"""What a bug report needs, without what tells who somebody is."""

from __future__ import annotations

import contextlib
import os
import platform
from collections.abc import Iterator

import bpy

from ...places import EXTENSION, backend_module_path, preference
from .memory import device_line
from .queue import queue

TEXT = "PrimDiffusion Diagnostics"
_LOG_LINES = 60
_PATHS = ("backend_python", "checkpoint", "encoder")


def diagnostics() -> str:
    """Versions, device, memory, the last work, its error and the end of the child's log; redacted."""
    from ...worker.redact import redact

    return redact("\n".join(_lines()), _names())


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
    yield f"Running: {queue.child_pid is not None}; queued: {len(queue.waiting)}"
    if queue.current is not None:
        yield f"At work: {queue.current.work.label}: {queue.job.state}, {queue.job.message}"
    if (outcome := queue.last) is not None:
        spent = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in outcome.seconds.items())
        yield f"Last work: {outcome.entry.work.label} ({outcome.entry.work.method}) {spent}"
        yield f"Ended: {outcome.notice or 'with an error'}"
        if outcome.error is not None:
            yield f"Error ({outcome.error.kind}): {outcome.sentence}"
    error = queue.last.error if queue.last is not None else None
    log = error.log if error is not None and error.log else queue.log
    yield f"Log, the last {min(len(log), _LOG_LINES)} lines:"
    yield from (f"    {line}" for line in log[-_LOG_LINES:])


def _version() -> str:
    manifest = os.path.join(os.path.dirname(os.path.dirname(os.path.dirname(__file__))), "blender_manifest.toml")
    try:
        import tomllib

        with open(manifest, "rb") as file:
            return tomllib.load(file)["version"]
    except (OSError, ValueError, KeyError):
        return "of unknown version"


def _window() -> str:
    return "no window" if bpy.app.background else "with a window"


def _names() -> set[str]:
    """Of the user and the machine; those of the home folder too, which may differ."""
    import getpass
    import socket

    home = os.path.basename(os.path.expanduser("~"))
    names = {home, os.environ.get("USER", ""), os.environ.get("USERNAME", ""), socket.gethostname(), platform.node()}
    with contextlib.suppress(OSError, KeyError, ImportError):  # no such user on this system (containers)
        names.add(getpass.getuser())
    return names


class PRIMDIFFUSION_OT_copy_diagnostics(bpy.types.Operator):
    """Copy what a bug report needs: versions, device, the last error and the log, without names and folders"""

    bl_idname = "primdiffusion.copy_diagnostics"
    bl_label = "Copy Diagnostics"
    bl_options: set[str] = set()  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Without a window there is no clipboard: then a text block of the file holds it."""
        text = diagnostics()
        if bpy.app.background:
            block = bpy.data.texts.get(TEXT) or bpy.data.texts.new(TEXT)
            block.from_string(text)
            self.report({"INFO"}, f"the text {TEXT!r} holds them")
        else:
            context.window_manager.clipboard = text
            self.report({"INFO"}, "copied: paste it into the report, and read it first")
        return {"FINISHED"}
