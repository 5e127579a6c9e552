"""The memory of this machine, and its torch device."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil

if TYPE_CHECKING:
    import torch

GB = 1e9
DEVICES = ("cpu", "cuda", "mps")
_CHOSEN = "PRIMDIFFUSION_DEVICE"
"""Environment variable, so that processes that this one starts use the same device."""


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

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if sys.platform == "darwin":
        return peak / GB
    # Linux's ru_maxrss begins with the peak of the program that started this one; not every sandbox has VmHWM.
    own = re.search(r"^VmHWM:\s+(\d+) kB$", Path("/proc/self/status").read_text(encoding="utf-8"), re.MULTILINE)
    return (int(own[1]) if own else peak) * 1024 / GB


def choose_device(name: str) -> None:
    """Make `best_device` return this device; call before importing torch. ValueError for a name not in DEVICES.

    Operations that torch does not have on Apple GPUs (mps) then run on the CPU.
    """
    if name not in DEVICES:
        raise ValueError(f"there is no device {name!r}: choose one of {', '.join(DEVICES)}")
    os.environ[_CHOSEN] = name
    if name == "mps":
        os.environ["PYTORCH_ENABLE_MPS_FALLBACK"] = "1"


def best_device() -> torch.device:
    """Return the chosen device, or else CUDA if available, otherwise the CPU.

    Raises ValueError if this machine does not have the chosen device.
    """
    import torch  # late: `memory` does not need it

    name = os.environ.get(_CHOSEN) or ("cuda" if torch.cuda.is_available() else "cpu")
    if name == "mps" and not torch.backends.mps.is_available():
        raise ValueError(
            "the device mps, an Apple GPU, is not available: it needs macOS 14 on Apple silicon and a torch built for "
            "it; choose cpu"
        )
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError(
            "the device cuda is not available: it needs an NVIDIA GPU, its driver and a torch built for CUDA; "
            "choose cpu"
        )
    return torch.device(name)


def has_fast_bfloat16(device: torch.device) -> bool:
    """Whether the device multiplies bfloat16 faster than float32.

    A processor without instructions for it takes three times as long; so do those of which torch before 2.8 tells
    nothing. Graphics cards always count as faster.
    """
    import torch  # late: `memory` does not need it

    if device.type != "cpu":
        return True
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()
    return any(capabilities.get(name, False) for name in ("avx512_bf16", "amx_bf16", "bf16", "sve_bf16"))


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
    if device.type == "mps":
        total, used = torch.mps.recommended_max_memory(), torch.mps.driver_allocated_memory()
        return {
            "device": str(device),
            "device_name": "Apple GPU",
            "device_memory_gb": round(total / GB, 2),
            "device_memory_free_gb": round((total - used) / GB, 2),
        }
    threads = torch.get_num_threads()
    name = f"CPU, {threads} {'thread' if threads == 1 else 'threads'}"
    return {"device": str(device), "device_name": name, "device_memory_gb": None, "device_memory_free_gb": None}
