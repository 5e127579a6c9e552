"""The torch device that networks run on."""

from __future__ import annotations

import os
from typing import Any

import torch

from primdiffusion.machine import CHOSEN_DEVICE, GB


def best_device() -> torch.device:
    """Return the chosen device, or else CUDA if available, otherwise the CPU.

    Raises ValueError if this machine does not have the chosen device.
    """
    name = os.environ.get(CHOSEN_DEVICE) or ("cuda" if torch.cuda.is_available() else "cpu")
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

    A processor takes half as long again with AVX-512's instructions alone, and three times as long without any; the
    latter is assumed with torch before 2.8, which tells nothing. Graphics cards always count as faster.
    """
    return device.type != "cpu" or _has_instructions("amx_bf16", "bf16", "sve_bf16")


def has_bfloat16(device: torch.device) -> bool:
    """Whether the device has instructions that multiply bfloat16, fast or not."""
    return has_fast_bfloat16(device) or _has_instructions("avx512_bf16")


def _has_instructions(*names: str) -> bool:
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()
    return any(capabilities.get(name, False) for name in names)


def device_info(device: torch.device) -> dict[str, Any]:
    """Name and memory of the device, for `hello` and the panel; None for the CPU's memory."""
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
