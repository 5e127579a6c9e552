"""JSON-RPC 2.0, one message a line: framing, errors and typed parameters. Knows pipes and JSON, nothing of people.

A line is UTF-8 JSON without line breaks inside (json escapes them), ended by a newline. There are no batches.
"""

from __future__ import annotations

import dataclasses
import json
import math
import threading
import types
import typing
from typing import Any, BinaryIO, TypeVar

PARSE_ERROR = -32700
INVALID_REQUEST = -32600
METHOD_NOT_FOUND = -32601
INVALID_PARAMS = -32602
INTERNAL_ERROR = -32603
CANCELLED = -32001
DOMAIN_ERROR = -32002
"""An error of the subject, not of the protocol; `data.kind` names it, `data.remedy` says what to do next."""

T = TypeVar("T")
JsonId = str | int | float | None


class RpcError(Exception):
    """What a request fails with on the wire: a code, one sentence, and data for programs."""

    def __init__(self, code: int, message: str, data: dict[str, Any] | None = None):
        super().__init__(message)
        self.code = code
        self.data = data

    def as_object(self) -> dict[str, Any]:
        """The `error` member of a response."""
        error: dict[str, Any] = {"code": self.code, "message": str(self)}
        return error if self.data is None else {**error, "data": self.data}


@dataclasses.dataclass(frozen=True)
class Request:
    """One parsed message from the other side."""

    method: str
    params: dict[str, Any]
    id: JsonId
    wants_response: bool
    """False for notifications, which have no `id` member at all."""


class MalformedRequest(RpcError):
    """A line that is no request; `id` is the request's own where it could still be read, as JSON-RPC asks."""

    def __init__(self, code: int, message: str, id: JsonId = None):
        super().__init__(code, message)
        self.id = id


def parse_request(line: bytes) -> Request:
    """The request in one line. Raises MalformedRequest for anything that is not one JSON-RPC 2.0 request object."""
    try:
        message = json.loads(line.decode("utf-8"))
    except (ValueError, RecursionError) as e:
        raise MalformedRequest(PARSE_ERROR, f"the line is not JSON in UTF-8 ({e}): send one JSON object a line") from e
    if isinstance(message, list):
        raise MalformedRequest(INVALID_REQUEST, "batches are not supported: send one request a line")
    if not isinstance(message, dict):
        raise MalformedRequest(INVALID_REQUEST, f"a request is a JSON object, not {type(message).__name__}")
    id = message.get("id")
    if isinstance(id, bool) or not isinstance(id, str | int | float | None):
        raise MalformedRequest(INVALID_REQUEST, f"a request's id is a string or a number, not {type(id).__name__}")
    if isinstance(id, float) and not math.isfinite(id):
        raise MalformedRequest(INVALID_REQUEST, f"a request's id is a finite number, not {id}")
    if message.get("jsonrpc") != "2.0":
        raise MalformedRequest(INVALID_REQUEST, 'a request needs "jsonrpc": "2.0"', id)
    method, params = message.get("method"), message.get("params", {})
    if not isinstance(method, str):
        raise MalformedRequest(INVALID_REQUEST, "a request needs a method name", id)
    if not isinstance(params, dict):
        raise MalformedRequest(INVALID_PARAMS, f"params of {method!r} must be a JSON object with names", id)
    return Request(method, params, id, "id" in message)


def _json_type_fits(value: Any, annotation: Any) -> bool:
    if typing.get_origin(annotation) in (types.UnionType, typing.Union):
        return any(_json_type_fits(value, option) for option in typing.get_args(annotation))
    if annotation is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if annotation is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, typing.get_origin(annotation) or annotation)


def _record_of_entries(annotation: Any) -> type | None:
    """The dataclass R of an annotation list[R], otherwise None."""
    entries = typing.get_args(annotation)
    is_list = typing.get_origin(annotation) is list and len(entries) == 1
    return entries[0] if is_list and isinstance(entries[0], type) and dataclasses.is_dataclass(entries[0]) else None


def _read_entries(record: type[T], values: list[Any], name: str) -> list[T]:
    for value in values:
        if not isinstance(value, dict):
            raise RpcError(INVALID_PARAMS, f"every entry of {name} must be a JSON object: {value!r:.80} was given")
    return [read_params(record, value, f"{name}[{i}]") for i, value in enumerate(values)]


def read_params(record: type[T], params: dict[str, Any], method: str) -> T:
    """`params` as a frozen dataclass `record`: unknown, missing or wrongly typed names raise RpcError(INVALID_PARAMS).

    A field list[R] of a dataclass R takes a list of JSON objects, each read in the same way. A ValueError of the
    record's own `__post_init__` (ranges) becomes the same error.
    """
    fields = {field.name: field for field in dataclasses.fields(record)}  # type: ignore[arg-type]
    hints = typing.get_type_hints(record)
    if unknown := sorted(set(params) - set(fields)):
        known = ", ".join(fields) or "none"
        raise RpcError(
            INVALID_PARAMS, f"{method!r} does not know the parameter {unknown[0]!r}: its parameters are {known}"
        )
    for name, field in fields.items():
        if name not in params:
            if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
                raise RpcError(INVALID_PARAMS, f"{method!r} needs the parameter {name!r}: it was not given")
        elif not _json_type_fits(params[name], hints[name]):
            wanted = getattr(hints[name], "__name__", str(hints[name]))
            given = f"{params[name]!r:.80}"
            raise RpcError(INVALID_PARAMS, f"parameter {name!r} of {method!r} must be {wanted}: {given} was given")
    lists = {name: _record_of_entries(hints[name]) for name in params}
    read = {name: _read_entries(entry, params[name], f"{method}.{name}") for name, entry in lists.items() if entry}
    try:
        return record(**{**params, **read})
    except ValueError as e:
        raise RpcError(INVALID_PARAMS, f"{method!r}: {e}") from e


class Wire:
    """The writing end: whole lines from any thread, never interleaved."""

    def __init__(self, stream: BinaryIO):
        self._stream = stream
        self._lock = threading.Lock()

    def _send(self, message: dict[str, Any]) -> None:
        line = json.dumps({"jsonrpc": "2.0", **message}, allow_nan=False).encode("utf-8") + b"\n"
        with self._lock:
            self._stream.write(line)
            self._stream.flush()

    def respond(self, id: JsonId, result: Any) -> None:
        """The good end of a request."""
        self._send({"id": id, "result": result})

    def fail(self, id: JsonId, error: RpcError) -> None:
        """The bad end of a request."""
        self._send({"id": id, "error": error.as_object()})

    def notify(self, method: str, **params: Any) -> None:
        """A message nobody answers."""
        self._send({"method": method, "params": params})
