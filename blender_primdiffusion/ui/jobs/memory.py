"""What the child computes on, and the memory it holds: told, and given back."""

from __future__ import annotations

import bpy

from ...places import EXTENSION
from .queue import queue

IDLE_MINUTES = 10.0
"""Where the preferences do not say."""


def device_line() -> str:
    """What panels say of the device: its name, and its memory in all and free where the child has told."""
    if queue.child_news:
        return f"{queue.child_news}; starts anew with the next person"
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
    """End the child when nothing has been asked of it for `idle_minutes`; whether it was. `now`: time.monotonic()."""
    minutes = idle_minutes()
    if queue.busy or minutes <= 0 or now - queue.idle_since < minutes * 60:
        return False
    return queue.release() is not None


def release() -> str:
    """End the children that generate and draw; what that gave back, in a sentence.

    Raises RuntimeError while one of them is at work.
    """
    from ...engine import studio
    from ...worker.process_memory import resident_bytes

    if queue.busy:
        raise RuntimeError("the backend is at work: wait for it, or cancel it first")
    if bpy.app.is_job_running("RENDER"):
        raise RuntimeError("Blender is rendering: wait for it, or cancel it first")
    pids = [pid for pid in (queue.child_pid, studio.child_pid()) if pid is not None]
    if not pids:
        return "nothing was held: no backend runs"
    held = [size for size in map(resident_bytes, pids) if size is not None]
    queue.release()
    studio.close()
    card = f", and what they held of {queue.info['device_name']}" if queue.info.get("device_memory_gb") else ""
    size = f", {sum(held) / 1e9:.1f} GB of memory" if held else ""
    return f"{len(pids)} {'process' if len(pids) == 1 else 'processes'} ended{size}{card}"
