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
    """Lets torch's threads sleep while they wait for each other; call before torch is imported. A user's setting stays.

    By default they spin, and where another program (Blender) wants the same cores, each spins away its time slice: 30
    steps of the default model took 9 s instead of 0.6 s on 2 cores with other processes at work.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def memory() -> dict[str, float]:
    """Total and available memory of the machine in GB (1e9 bytes). Needs no torch."""
    now = psutil.virtual_memory()
    return {"memory_gb": round(now.total / GB, 2), "memory_free_gb": round(now.available / GB, 2)}


def peak_memory_gb() -> float:
    """The most memory this process has held at once so far, GB (1e9 bytes)."""
    if sys.platform == "win32":
        return psutil.Process().memory_info().peak_wset / GB
    import resource  # Windows has none

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / GB


def best_device() -> torch.device:
    """CUDA where torch sees one, otherwise the CPU."""
    import torch  # late: `memory` needs none

    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def device_info(device: torch.device) -> dict[str, Any]:
    """The device as `hello` and the panel state it: its name, and its own memory where it has some."""
    import torch  # late: `memory` needs none

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
