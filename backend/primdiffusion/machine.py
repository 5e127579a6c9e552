"""The memory of this machine, and its torch device."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Any

import psutil

if TYPE_CHECKING:
    import torch

GB = 1e9


def share_processors() -> None:
    """Let torch's threads sleep while waiting for each other, unless the user set it; call before importing torch.

    By default they spin, and waste time slices that other programs (Blender) need: 30 steps of the default model took
    9 s instead of 0.6 s on 2 busy cores.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def memory() -> dict[str, float]:
    """Total and available memory of the machine in GB (1e9 bytes). Needs no torch."""
    now = psutil.virtual_memory()
    return {"memory_gb": round(now.total / GB, 2), "memory_free_gb": round(now.available / GB, 2)}


def peak_memory_gb() -> float:
    """Peak memory of this process, GB (1e9 bytes)."""
    if sys.platform == "win32":
        return psutil.Process().memory_info().peak_wset / GB
    import resource  # not on Windows

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / GB


def best_device() -> torch.device:
    """Return CUDA if available, otherwise the CPU."""
    import torch  # late: `memory` does not need it

    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def device_info(device: torch.device) -> dict[str, Any]:
    """Name and memory of the device, for `hello` and the panel; None for the CPU's memory."""
    import torch  # late: `memory` does not need it

    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        return {
            "device": str(device),
            "device_name": torch.cuda.get_device_name(device),
            "device_memory_gb": round(total / GB, 2),
            "device_memory_free_gb": round(free / GB, 2),
        }
    threads = torch.get_num_threads()
    name = f"CPU, {threads} {'thread' if threads == 1 else 'threads'}"
    return {"device": str(device), "device_name": name, "device_memory_gb": None, "device_memory_free_gb": None}
