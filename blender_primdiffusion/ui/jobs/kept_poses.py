"""Many poses, as a kept work holds them: the line is written anew at each change of it, so they must be small."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

_NUMBERS = {"object": (3, 4), "joints": (24, 3, 4)}
"""Of a person as the child's `draw` takes them; the rest is the same in all poses, or short."""


def packed(people: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Parameters of one person in many poses as JSON: some 2 kB for each, as single floats."""
    people = list(people)
    return {
        "rest": [{name: value for name, value in person.items() if name not in _NUMBERS} for person in people],
        **{name: _text(np.array([person[name] for person in people])) for name in _NUMBERS},
    }


def unpacked(kept: dict[str, Any]) -> list[dict[str, Any]]:
    """The parameters of `packed`. Raises KeyError, TypeError or ValueError for what is none."""
    numbers = {name: _array(kept[name]).reshape(-1, *shape).tolist() for name, shape in _NUMBERS.items()}
    rows = [dict(zip(_NUMBERS, row, strict=True)) for row in zip(*numbers.values(), strict=True)]
    return [{**rest, **row} for rest, row in zip(kept["rest"], rows, strict=True)]


def _text(array: NDArray) -> str:
    return base64.b64encode(np.asarray(array, "<f4").tobytes()).decode("ascii")


def _array(text: str) -> NDArray[np.float32]:
    return np.frombuffer(base64.b64decode(text, validate=True), "<f4")
