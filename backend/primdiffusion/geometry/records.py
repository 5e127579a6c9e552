"""Frozen records of tensors: the nouns of this package move between devices and dtypes as one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Self

import torch
from torch import Tensor


@dataclasses.dataclass(frozen=True)
class TensorRecord:
    """A frozen dataclass whose tensor fields (nested records included) are converted and indexed together."""

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The same record with `change` applied to every tensor in it."""
        changed = {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                changed[field.name] = change(value)
            elif isinstance(value, TensorRecord):
                changed[field.name] = value.map(change)
        return dataclasses.replace(self, **changed)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """Move to `device`; convert floating tensors (only those) to `dtype`."""
        return self.map(lambda t: t.to(device=device, dtype=dtype if t.is_floating_point() else None))
