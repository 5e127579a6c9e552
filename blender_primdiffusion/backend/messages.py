"""Messages of the child: parsed, and checked before any of them reaches Blender (docs/design/protocol.md)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ..formats.json_files import parse_message


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
}  # fmt: skip
"""Types of what the child reports, where it reports it (docs/design/protocol.md)."""


def fault_of(message: Mapping[str, Any], hello: int) -> str | None:
    """What is wrong with a message, if anything: it names the member that is not of its type."""
    id, method, error = message.get("id"), message.get("method"), message.get("error")
    params, result = message.get("params"), message.get("result")
    if not (id is None or type(id) is int):
        return "id"
    if "method" in message:
        if not isinstance(method, str):
            return "method"
        if not isinstance(params, dict | None):
            return "params"
        return _faulty_member(params or {})
    if "error" in message:
        if (
            not isinstance(error, dict)
            or type(error.get("code")) is not int
            or not isinstance(error.get("message"), str)
        ):
            return "error"
        data = error.get("data")
        if not (data is None or (isinstance(data, dict) and all(isinstance(data.get(k, ""), str) for k in _DATA))):
            return "data of error"
        return None
    if "result" not in message or not isinstance(result, dict):
        return "result"
    return _faulty_member(result) if id == hello else None


_DATA = ("kind", "remedy")


def _faulty_member(members: Mapping[str, Any]) -> str | None:
    for name, value in members.items():
        kinds = _KINDS.get(name, (object,))
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds and object not in kinds):
            return name
        if isinstance(value, float) and not math.isfinite(value):
            return name
    return None
