"""The marcher: primitives and a camera to a picture (SPEC 4; paper sec. 3.1, "Efficient Decoder-free Rendering")."""

from __future__ import annotations

import torch

from primdiffusion.geometry.camera import Camera
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.compositing import Rendering
from primdiffusion.render.cpu import march_cpu
from primdiffusion.render.lattice import MarchSettings
from primdiffusion.render.reference import march_reference

__all__ = ["MarchSettings", "Rendering", "march"]


def march(primitives: Primitives, camera: Camera, settings: MarchSettings = MarchSettings()) -> Rendering:  # noqa: B008
    """The picture of `primitives` (unbatched) from `camera`: premultiplied linear rgb [H, W, 3], alpha, depth (metres).

    The rule is in `march_reference`. float32 tensors on the CPU without gradients go to the fast `march_cpu`; other
    dtypes, devices and anything that needs gradients to `march_reference`. Raises ValueError as `check_scene` does.
    """
    tensors = [*vars(primitives).values(), camera.intrinsics, camera.world_to_camera]
    plain = all(tensor.dtype == torch.float32 and tensor.device.type == "cpu" for tensor in tensors)
    differentiable = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    draw = march_cpu if plain and not differentiable else march_reference
    return draw(primitives, camera, settings)
