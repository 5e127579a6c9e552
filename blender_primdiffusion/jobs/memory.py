"""What the child computes on, and the memory it holds: shown in panels, and released."""

from __future__ import annotations

import os
import subprocess

import bpy

from ..engine import drawing_child
from ..places import EXTENSION
from ..scene.volumes import free_unused_grids
from .queue import queue


def resident_bytes(pid: int) -> int | None:
    """Physical memory of a process; None on Windows, or where the process is gone."""
    if os.name == "nt":
        return None
    try:
        shown = subprocess.run(["ps", "-o", "rss=", "-p", str(pid)], capture_output=True, timeout=1.0, check=True)
        return int(shown.stdout) * 1024
    except (OSError, subprocess.SubprocessError, ValueError):
        return None


IDLE_MINUTES = 10.0
"""Default, where the preferences have none."""
_WORTH_REPORTING = 50e6
"""Bytes."""


def device_line() -> str:
    """The device as panels show it: its name, and its total and free memory as far as the child has reported them."""
    if queue.child_message:
        return f"{queue.child_message}; restarts with the next human"
    info = queue.info
    if not info.get("device_name"):
        return "starts with the first human"
    of = "device_memory" if info.get("device_memory_gb") else "memory"
    total, free = info.get(f"{of}_gb"), info.get(f"{of}_free_gb")
    if not total:
        return str(info["device_name"])
    left = f", {free:.1f} GB free at its start" if free is not None else ""
    return f"{info['device_name']}, {total:.1f} GB{left}"


def idle_minutes() -> float:
    """Minutes after which an idle child is ended; 0 for never."""
    addon = bpy.context.preferences.addons.get(EXTENSION)
    return float(getattr(addon.preferences, "idle_minutes", IDLE_MINUTES)) if addon is not None else IDLE_MINUTES


def release_when_idle(now: float) -> bool:
    """End the child after `idle_minutes` without a job; whether it was ended. `now`: time.monotonic().

    Grids that Blender can read again are freed with it.
    """
    minutes = idle_minutes()
    if queue.busy or minutes <= 0 or now - queue.idle_since < minutes * 60:
        return False
    if queue.release() is None:
        return False
    if not bpy.app.is_job_running("RENDER"):
        free_unused_grids()
    return True


def release() -> str:
    """End the children that generate and draw, and free grids that Blender can read again; returns what was freed.

    Raises RuntimeError while one of them is busy.
    """
    if queue.busy:
        raise RuntimeError("the backend is busy: wait for it, or cancel the job first")
    if bpy.app.is_job_running("RENDER"):
        raise RuntimeError("Blender is rendering: wait for it, or cancel it first")
    pids = [pid for pid in (queue.child_pid, drawing_child.child_pid()) if pid is not None]
    held = [size for size in map(resident_bytes, pids) if size is not None]
    queue.release()
    drawing_child.close()
    before = resident_bytes(os.getpid()) or 0
    free_unused_grids()
    grids = before - (resident_bytes(os.getpid()) or before)
    freed = (
        f"Blender gave back {grids / 1e9:.1f} GB of volumes, read again when needed" if grids > _WORTH_REPORTING else ""
    )
    if not pids:
        return freed or "nothing to release: the backend is not running"
    card = f", and what they held of {queue.info['device_name']}" if queue.info.get("device_memory_gb") else ""
    size = f", {sum(held) / 1e9:.1f} GB of memory" if held else ""
    ended = f"{len(pids)} {'process' if len(pids) == 1 else 'processes'} ended{size}{card}"
    return f"{ended}; {freed}" if freed else ended
