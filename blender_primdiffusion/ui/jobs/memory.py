"""What the child computes on, and the memory it holds."""

from __future__ import annotations

from .queue import queue


def device_line() -> str:
    """What panels say of the device: its name, and its memory in all and free where the child has told."""
    info = queue.info
    if not info.get("device_name"):
        return "starts with the first person"
    own = info.get("device_memory_gb")
    total, free = (
        (own, info.get("device_memory_free_gb")) if own else (info.get("memory_gb"), info.get("memory_free_gb"))
    )
    if not total:
        return f"{info['device_name']}"
    left = f", {free:.1f} free at its start" if free is not None else ""
    return f"{info['device_name']}, {total:.1f} GB{left}"
