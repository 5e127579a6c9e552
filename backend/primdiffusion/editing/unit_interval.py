"""The numbers from 0 to 1 that edits are told. Imports no torch."""

from __future__ import annotations


def check_unit_interval(name: str, value: float) -> None:
    """ValueError unless `value` lies in 0 ... 1."""
    if not 0 <= value <= 1:
        raise ValueError(f"{name} is {value}: choose a number from 0 to 1")
