"""Read untrusted JSON: limited size, count of values, depth and numbers, so that readers of the result cannot overflow.

Errors of a text are reasons without the file's name: "it is nested more than 64 deep".
Needs no numpy.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from .regular_files import read_regular

LARGEST_BYTES = 32 * 2**20
MOST_VALUES = 4_000_000
"""Numbers, strings and so on in a text."""
MOST_CONTAINERS = 500_000
"""Lists and objects in a text."""
DEEPEST = 64
"""Levels of nested lists and objects."""
LARGEST_INTEGER = 2**63 - 1
"""Larger integers are read as floats, infinite beyond these: conversion to float would raise OverflowError."""


def read_json(path: str | Path) -> Any:
    """Read a JSON file as `parse_json` does. Raises ValueError, FileError and OSError."""
    return parse_json(read_regular(path, LARGEST_BYTES))


def parse_json(text: str | bytes) -> Any:
    """Parse JSON whose numbers are all finite. Raises ValueError."""
    return _checked(_parsed(text), finite=True)


def parse_message(text: str | bytes) -> Any:
    """Same as `parse_json`, with numbers that may be NaN or infinite, for readers that name the faulty parameter."""
    return _checked(_parsed(text), finite=False)


def _parsed(text: str | bytes) -> Any:
    if not isinstance(text, str | bytes):
        raise ValueError(f"it is not text but {type(text).__name__}")
    try:
        text = text if isinstance(text, str) else text.decode("utf-8")
    except UnicodeDecodeError as e:
        raise ValueError(f"it is not UTF-8 text: byte {e.start}") from e
    if len(text) > LARGEST_BYTES:
        raise ValueError(f"it is longer than {LARGEST_BYTES // 2**20} MB")
    if text.count("[") + text.count("{") > MOST_CONTAINERS or text.count(",") > MOST_VALUES:
        raise ValueError(f"it holds more than {MOST_CONTAINERS} lists or {MOST_VALUES} values")
    try:
        return json.loads(text, parse_int=_number)
    except RecursionError as e:
        raise ValueError(f"it is nested more than {DEEPEST} deep") from e
    except ValueError as e:
        raise ValueError(str(e)[:120]) from e


def _number(digits: str) -> int | float:
    if len(digits) <= 21 and abs(whole := int(digits)) <= LARGEST_INTEGER:
        return whole
    return float(digits)


def _checked(tree: Any, *, finite: bool) -> Any:
    level = [tree]
    for _ in range(DEEPEST + 1):
        if finite and any(isinstance(value, float) and not math.isfinite(value) for value in level):
            raise ValueError("it holds NaN or infinite numbers")
        level = [
            entry
            for value in level
            if isinstance(value, dict | list)
            for entry in (value.values() if isinstance(value, dict) else value)
        ]
        if not level:
            return tree
    raise ValueError(f"it is nested more than {DEEPEST} deep")
