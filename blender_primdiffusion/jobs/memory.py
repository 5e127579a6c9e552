"""What the child computes on, and the memory it holds: shown in panels, and released."""

from __future__ import annotations

import bpy

from ..engine import drawing_child
from ..places import EXTENSION
from ..scene.volumes import free_unused_grids
from .queue import queue

IDLE_MINUTES = 10.0
"""Default, where the preferences have none."""


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


def release() -> None:
    """End the children that generate and draw, and free grids that Blender can read again.

    Raises ValueError while one of them is busy.
    """
    if queue.busy:
        raise ValueError("the backend is busy: wait for it, or cancel the job first")
    if bpy.app.is_job_running("RENDER"):
        raise ValueError("Blender is rendering: wait for it, or cancel it first")
    queue.release()
    drawing_child.close()
    free_unused_grids()
