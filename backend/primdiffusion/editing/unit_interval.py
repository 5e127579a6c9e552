"""Validation of parameters in [0, 1]. Imports no torch."""

from __future__ import annotations


def check_unit_interval(name: str, value: float) -> None:
    """Raise ValueError unless `value` is in [0, 1]."""
    if not 0 <= value <= 1:
        raise ValueError(f"{name} is {value}: choose a number from 0 to 1")
