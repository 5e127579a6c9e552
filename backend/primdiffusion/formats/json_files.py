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
    """As `parse_json`, with numbers that may be NaN or infinite, for readers that name the faulty parameter."""
    return _checked(_parsed(text), finite=False)


class Pairs(list[tuple[str, Any]]):
    """A JSON object as the names and values in its text, in which a name may occur twice."""


def parse_pairs(text: bytes, deepest: int) -> Any:
    """Parse JSON as strictly as serde_json, the parser of the safetensors library; objects become `Pairs`.

    Unlike Python's parser it rejects NaN and infinite numbers, floats that overflow, halves of surrogate pairs, and
    values nested more than `deepest` levels. Integers outside 64 bits and -0 are floats. Of the limits of this module
    none applies: the caller limits the length of the text. Raises ValueError.
    """
    try:
        decoded = text.decode("utf-8")
        tree = json.loads(
            decoded, object_pairs_hook=Pairs, parse_int=_integer, parse_float=_finite, parse_constant=_constant
        )
    except UnicodeDecodeError as e:
        raise ValueError(f"it is not UTF-8 text: byte {e.start}") from e
    except RecursionError as e:
        raise ValueError(f"it is nested more than {deepest} deep") from e
    except ValueError as e:
        raise ValueError(str(e)[:120]) from e
    _check_pairs(tree, deepest, escapes="\\u" in decoded)
    return tree


def _integer(digits: str) -> int | float:
    if len(digits) > 20 or digits == "-0":
        return _finite(digits)
    number = int(digits)
    return number if -(2**63) <= number < 2**64 else float(number)


def _finite(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError("a number is out of range")
    return number


def _constant(name: str) -> float:
    raise ValueError(f"{name} is not a number of JSON")


def _check_pairs(tree: Any, deepest: int, *, escapes: bool) -> None:
    """Check the depth of a tree of `parse_pairs`, and its strings if the text contains `escapes`."""
    level = [tree]
    for depth in range(deepest + 2):
        if escapes:  # without escapes, decoding has already rejected halves of pairs
            _check_strings(level)
        level = [value for value in level if isinstance(value, list)]
        if not level:
            return
        if depth == deepest:
            break
        level = [entry[1] if isinstance(container, Pairs) else entry for container in level for entry in container]
    raise ValueError(f"it is nested more than {deepest} deep")


def _check_strings(values: list[Any]) -> None:
    names = [pair[0] for value in values if isinstance(value, Pairs) for pair in value]
    for text in (*names, *(value for value in values if isinstance(value, str))):
        try:
            text.encode("utf-8")
        except UnicodeEncodeError as e:
            raise ValueError(f"the text {text!r:.40} contains half of a surrogate pair") from e


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
