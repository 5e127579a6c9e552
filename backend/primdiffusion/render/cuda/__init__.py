"""The marcher on NVIDIA GPUs, compiled by Triton, which is optional: import `march` where it is `available` alone."""

from __future__ import annotations

import importlib.util

import torch

from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives, S


def available(device: torch.device | str = "cuda") -> bool:
    """Whether `march_cuda` can run on `device`, which requires CUDA and Triton."""
    return torch.device(device).type == "cuda" and importlib.util.find_spec("triton") is not None


def supports(primitives: Primitives, camera: Camera) -> bool:
    """Whether `march_cuda` supports the scene: float32, voxels of 8^3."""
    tensors = [*vars(primitives).values(), camera.intrinsics, camera.world_to_camera]
    single = all(tensor.dtype == torch.float32 for tensor in tensors)
    return single and primitives.density.shape[-3:] == (S, S, S)
