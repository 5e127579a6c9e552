"""Messages of the child: parsed, and checked before any of them reaches Blender (docs/design/protocol.md)."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

from ..formats.json_files import parse_message

LARGEST_NUMBER = 2.0**63
LONGEST_TEXT = 8192
"""Characters of a path, or of a sentence for the user."""
_SURROGATE = re.compile("[\ud800-\udfff]")
"""Halves of characters, which JSON can name and Blender cannot show."""


class MessageError(ValueError):
    """A line of the child that cannot be read; the message says why."""


def parsed(line: bytes) -> dict[str, Any] | None:
    """The message in a line of the child; None for a line that does not begin with a brace, which is other output.

    Raises MessageError for a message that is not JSON.
    """
    if not line.lstrip().startswith(b"{"):
        return None
    try:
        return parse_message(line)
    except ValueError as error:
        raise MessageError("not JSON") from error


_KINDS: dict[str, tuple[type, ...]] = {
    "step": (int,), "total": (int,), "index": (int,), "eta_s": (int, float, type(None)), "stage": (str,),
    "picture": (str, type(None)), "ready": (bool,), "problem": (str, type(None)), "device": (str, type(None)),
    "device_name": (str, type(None)), "version": (str,), "python": (str,), "executable": (str,), "pid": (int,),
    "protocol": (int,), "memory_gb": (int, float), "memory_free_gb": (int, float),
    "seconds": (int, float),
    "device_memory_gb": (int, float, type(None)), "device_memory_free_gb": (int, float, type(None)),
}  # fmt: skip
"""Types of what the child reports, where it reports it (docs/design/protocol.md)."""


_PROGRESS = {"id": (int,), "stage": (str,), "step": (int,), "total": (int,)}
_PERSON = {"human": (str,), "person": (str,), "seconds": (int, float)}
_PERSON_OF_SHEET = {"seed": (int,), "human": (str,), "person": (str,), "picture": (str,)}
_ANSWERS: dict[str, dict[str, tuple[type, ...]]] = {
    **dict.fromkeys(("generate", "vary", "interpolate", "inpaint", "transfer", "human_npz"), _PERSON),
    "reconstruct": {**_PERSON, "warnings": (list,)},
    "variations": {"people": (list,), "seconds": (int, float)},
    "merge": {"out": (str,), "seconds": (int, float)},
    "merge_frames": {"files": (list,), "seconds": (int, float)},
    "proxy": {"proxy": (str,), "texture": (str,), "betas": (list,), "triangles": (int,), "seconds": (int, float)},
    "gaussians": {"out": (str,), "gaussians": (int,)},
}
"""What results must hold, by method, for what is made of them in Blender."""
_CAPTURES: dict[str, tuple[type, ...]] = {
    "subject": (str,), "done": (int,), "total": (int,), "eta_s": (int, float, type(None)), "news": (list,),
}  # fmt: skip
"""Progress of captures."""
_ENTRIES: dict[str, tuple[type, ...]] = {
    "warnings": (str,), "news": (str,), "files": (str,), "betas": (int, float), "people": (dict,),
}  # fmt: skip
"""What the lists in results hold."""
_DATA = ("kind", "remedy")


def fault_of(message: Mapping[str, Any], asked: Mapping[int, str]) -> str | None:
    """What is wrong with a message, if anything: it names the member that is not of its type.

    `asked`: methods of the requests that have had no answer, by id.
    """
    id, method, error = message.get("id"), message.get("method"), message.get("error")
    params, result = message.get("params"), message.get("result")
    if not (id is None or type(id) is int):
        return "id"
    if "method" in message:
        if not isinstance(method, str):
            return "method"
        if not isinstance(params, dict | None):
            return "params"
        return _faulty_member(params or {}, _PROGRESS if method == "progress" else {})
    if id is None or id not in asked:  # never, or it was answered before; none: our own line was not understood
        return "id"
    if "error" in message:
        if not isinstance(error, dict) or type(error.get("code")) is not int or not _is_text(error.get("message")):
            return "error"
        data = error.get("data")
        if not (data is None or (isinstance(data, dict) and all(_is_text(data.get(k, "")) for k in _DATA))):
            return "data of error"
        return None
    if not isinstance(result, dict):
        return "result"
    return _faulty_result(result, _ANSWERS.get(asked[id], {}))


def captures_message(text: str) -> dict[str, Any]:
    """A message of the Blender that renders captures: a line for the user, or progress. Raises MessageError."""
    try:
        message = parse_message(text)
    except ValueError as error:
        raise MessageError("not JSON") from error
    if not isinstance(message, dict):
        raise MessageError("not an object")
    needed = {"line": (str,)} if "line" in message else _CAPTURES
    if fault := _faulty_result(message, needed):
        raise MessageError(fault)
    return message


def _faulty_result(result: Mapping[str, Any], needed: Mapping[str, tuple[type, ...]]) -> str | None:
    if fault := _faulty_member(result, needed):
        return fault
    for name in needed.keys() & _ENTRIES.keys():
        for entry in result[name]:
            if not _is(entry, _ENTRIES[name]) or (name == "people" and _faulty_member(entry, _PERSON_OF_SHEET)):
                return name
    return None


def _faulty_member(members: Mapping[str, Any], needed: Mapping[str, tuple[type, ...]]) -> str | None:
    kinds = {**_KINDS, **needed}
    for name in (*members, *needed):
        if name not in members or (name in kinds and not _is(members[name], kinds[name])):
            return name
        if isinstance(members[name], float) and not math.isfinite(members[name]):
            return name
    return None


def _is(value: Any, kinds: tuple[type, ...]) -> bool:
    """Numbers are within `LARGEST_NUMBER`, and not negative where they are whole: those count. Texts are shown."""
    if isinstance(value, bool):
        return bool in kinds
    if isinstance(value, int | float) and not -LARGEST_NUMBER < value < LARGEST_NUMBER:  # nor NaN
        return False
    if isinstance(value, int) and kinds == (int,) and value < 0:
        return False
    return isinstance(value, kinds) and not (isinstance(value, str) and not _is_text(value))


def _is_text(value: object) -> bool:
    return isinstance(value, str) and len(value) <= LONGEST_TEXT and "\0" not in value and not _SURROGATE.search(value)
