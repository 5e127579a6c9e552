"""What the benchmarks of the marcher share, on machines that cannot make people too."""

from __future__ import annotations

import math
from typing import TypeVar

import torch
from primdiffusion.geometry.camera import Camera, look_at
from primdiffusion.geometry.records import TensorRecord

OPERATIONS_PER_SAMPLE = 136
Record = TypeVar("Record", bound=TensorRecord)


def portrait(size: int) -> Camera:
    """A camera that sees the whole person in a square picture; the body's origin is near its pelvis."""
    position, target = torch.tensor([0.6, 0.1, 3.2]), torch.tensor([0.0, -0.3, 0.0])
    return look_at(position, target, vertical_fov=math.radians(32), width=size, height=size)


def leaves(record: Record) -> Record:
    """The same values as tensors that collect gradients."""
    return record.map(lambda tensor: tensor.detach().clone().requires_grad_())
