"""JSON-RPC 2.0, one message per line: framing and errors.

A line is UTF-8 JSON without line breaks (json escapes them) and ends with a newline. There are no batches.
"""

from __future__ import annotations

import dataclasses
import json
import math
import threading
from typing import Any, BinaryIO

from primdiffusion.formats.json_files import parse_message

PARSE_ERROR = -32700
INVALID_REQUEST = -32600
METHOD_NOT_FOUND = -32601
INVALID_PARAMS = -32602
INTERNAL_ERROR = -32603
CANCELLED = -32001
DOMAIN_ERROR = -32002
"""An error of a request rather than the protocol; `data.kind` is its kind, `data.remedy` what to do next."""

JsonId = str | int | float | None


class RpcError(Exception):
    """The error of a response: a code, one sentence, and data for programs.

    Of a line that is no request, `id` is the request's if it could be read, as JSON-RPC requires.
    """

    def __init__(self, code: int, message: str, data: dict[str, Any] | None = None, *, id: JsonId = None):
        super().__init__(message)
        self.code, self.data, self.id = code, data, id

    def as_object(self) -> dict[str, Any]:
        """The `error` member of a response."""
        error: dict[str, Any] = {"code": self.code, "message": str(self)}
        return error if self.data is None else {**error, "data": self.data}


@dataclasses.dataclass(frozen=True)
class RpcRequest:
    """A parsed message."""

    method: str
    params: dict[str, Any]
    id: JsonId
    wants_response: bool
    """False for notifications, which have no `id` member at all."""


def parse_request(line: bytes) -> RpcRequest:
    """Parse a line. Raises RpcError unless it is one JSON-RPC 2.0 request object."""
    try:
        message = parse_message(line)
    except ValueError as e:
        raise RpcError(PARSE_ERROR, f"the line is not JSON in UTF-8 ({e!s:.160}): send one JSON object a line") from e
    if isinstance(message, list):
        raise RpcError(INVALID_REQUEST, "batches are not supported: send one request a line")
    if not isinstance(message, dict):
        raise RpcError(INVALID_REQUEST, f"a request is a JSON object, not {type(message).__name__}")
    id = message.get("id")
    if isinstance(id, bool) or not isinstance(id, str | int | float | None):
        raise RpcError(INVALID_REQUEST, f"a request's id is a string or a number, not {type(id).__name__}")
    if isinstance(id, float) and not math.isfinite(id):
        raise RpcError(INVALID_REQUEST, f"a request's id is a finite number, not {id}")
    if message.get("jsonrpc") != "2.0":
        raise RpcError(INVALID_REQUEST, 'a request needs "jsonrpc": "2.0"', id=id)
    method, params = message.get("method"), message.get("params", {})
    if not isinstance(method, str):
        raise RpcError(INVALID_REQUEST, "a request needs a method name", id=id)
    if not isinstance(params, dict):
        raise RpcError(INVALID_PARAMS, f"params of {method!r:.60} must be a JSON object with names", id=id)
    return RpcRequest(method, params, id, "id" in message)


class Wire:
    """Writes whole lines from any thread."""

    def __init__(self, stream: BinaryIO):
        self._stream = stream
        self._lock = threading.Lock()

    def _send(self, message: dict[str, Any]) -> None:
        line = json.dumps({"jsonrpc": "2.0", **message}, allow_nan=False).encode("utf-8") + b"\n"
        with self._lock:
            self._stream.write(line)
            self._stream.flush()

    def respond(self, id: JsonId, result: Any) -> None:
        """Send the result of a request."""
        self._send({"id": id, "result": result})

    def fail(self, id: JsonId, error: RpcError) -> None:
        """Send the error of a request."""
        self._send({"id": id, "error": error.as_object()})

    def notify(self, method: str, **params: Any) -> None:
        """Send a notification."""
        self._send({"method": method, "params": params})
