"""What the child computes on, and the memory it holds: told, and given back."""

from __future__ import annotations

import os

import bpy

from ..places import EXTENSION
from .queue import queue

IDLE_MINUTES = 10.0
"""Where the preferences do not say."""
_WORTH_TELLING = 50e6
"""Bytes."""


def device_line() -> str:
    """What panels say of the device: its name, and its memory in all and free where the child has told."""
    if queue.child_news:
        return f"{queue.child_news}; restarts with the next person"
    info = queue.info
    if not info.get("device_name"):
        return "starts with the first person"
    of = "device_memory" if info.get("device_memory_gb") else "memory"
    total, free = info.get(f"{of}_gb"), info.get(f"{of}_free_gb")
    if not total:
        return str(info["device_name"])
    left = f", {free:.1f} GB free at its start" if free is not None else ""
    return f"{info['device_name']}, {total:.1f} GB{left}"


def idle_minutes() -> float:
    """After how long a child that nobody needs is ended; 0: never."""
    addon = bpy.context.preferences.addons.get(EXTENSION)
    return float(getattr(addon.preferences, "idle_minutes", IDLE_MINUTES)) if addon is not None else IDLE_MINUTES


def release_when_idle(now: float) -> bool:
    """End the child when nothing has been asked of it for `idle_minutes`; whether it was. `now`: time.monotonic().

    Grids that Blender can read again are freed with it.
    """
    minutes = idle_minutes()
    if queue.busy or minutes <= 0 or now - queue.idle_since < minutes * 60:
        return False
    if queue.release() is None:
        return False
    if not bpy.app.is_job_running("RENDER"):
        from ..scene.grid_cache import free_unused_grids

        free_unused_grids()
    return True


def release() -> str:
    """End the children that generate and draw, and free grids that Blender can read again; what that gave back.

    Raises RuntimeError while one of them is busy.
    """
    from ..engine import studio
    from ..scene.grid_cache import free_unused_grids
    from ..worker.process_memory import resident_bytes

    if queue.busy:
        raise RuntimeError("the backend is busy: wait for it, or cancel the job first")
    if bpy.app.is_job_running("RENDER"):
        raise RuntimeError("Blender is rendering: wait for it, or cancel it first")
    pids = [pid for pid in (queue.child_pid, studio.child_pid()) if pid is not None]
    held = [size for size in map(resident_bytes, pids) if size is not None]
    queue.release()
    studio.close()
    before = resident_bytes(os.getpid()) or 0
    free_unused_grids()
    grids = before - (resident_bytes(os.getpid()) or before)
    freed = (
        f"Blender gave back {grids / 1e9:.1f} GB of volumes, read again when needed" if grids > _WORTH_TELLING else ""
    )
    if not pids:
        return freed or "nothing to release: the backend is not running"
    card = f", and what they held of {queue.info['device_name']}" if queue.info.get("device_memory_gb") else ""
    size = f", {sum(held) / 1e9:.1f} GB of memory" if held else ""
    ended = f"{len(pids)} {'process' if len(pids) == 1 else 'processes'} ended{size}{card}"
    return f"{ended}; {freed}" if freed else ended
