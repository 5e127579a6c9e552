"""Frozen records of tensors that move between devices and dtypes as a unit, and whose shapes can be checked."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Self, get_type_hints

import torch
from jaxtyping import jaxtyped
from torch import Tensor


@dataclasses.dataclass(frozen=True)
class TensorRecord:
    """A frozen dataclass whose tensor fields, including those of nested records, are converted together."""

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """Return a copy with `change` applied to every tensor."""
        changed = {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                changed[field.name] = change(value)
            elif isinstance(value, TensorRecord):
                changed[field.name] = value.map(change)
        return dataclasses.replace(self, **changed)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Self:
        """Return a copy on `device`, with floating-point tensors (only those) converted to `dtype`."""
        return self.map(lambda t: t.to(device=device, dtype=dtype if t.is_floating_point() else None))


def check_shapes(*records: TensorRecord) -> None:
    """Raise ValueError unless tensors have the shapes of their annotations; a name is one size in all records.

    Records inside records are not looked at.
    """
    with jaxtyped("context"):
        for record in records:
            for name, hint in get_type_hints(type(record)).items():
                value = getattr(record, name)
                if isinstance(value, Tensor) and not isinstance(value, hint):
                    raise ValueError(f"{name} has shape {tuple(value.shape)}, which does not fit {hint.__name__}")
