"""The memory of this machine, and the choice of its torch device (`device`). Needs no torch."""

from __future__ import annotations

import os

import psutil

GB = 1e9
DEVICES = ("cpu", "cuda", "mps")
CHOSEN_DEVICE = "PRIMDIFFUSION_DEVICE"
"""Environment variable, so that processes that this one starts use the same device."""


def share_processors() -> None:
    """Let torch's threads sleep while waiting for each other, unless the user set it; call before importing torch.

    By default they spin, and waste time slices that other programs (Blender) need: 30 steps of the default model took
    9 s instead of 0.6 s on 2 busy cores.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def memory() -> dict[str, float]:
    """Total and available memory of the machine in GB (1e9 bytes)."""
    now = psutil.virtual_memory()
    return {"memory_gb": round(now.total / GB, 2), "memory_free_gb": round(now.available / GB, 2)}


def choose_device(name: str) -> None:
    """Make `device.best_device` return this device; call before importing torch. ValueError for a name not in DEVICES.

    Operations that torch does not have on Apple GPUs (mps) then run on the CPU.
    """
    if name not in DEVICES:
        raise ValueError(f"there is no device {name!r}: choose one of {', '.join(DEVICES)}")
    os.environ[CHOSEN_DEVICE] = name
    if name == "mps":
        os.environ["PYTORCH_ENABLE_MPS_FALLBACK"] = "1"
