"""Requests: frozen records that are read from JSON or from a command line. Imports no torch."""

from __future__ import annotations

import contextlib
import dataclasses
import types
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, TypeVar

import tyro

if TYPE_CHECKING:
    from primdiffusion.commands.progress import Report
    from primdiffusion.commands.session import Session

R = TypeVar("R")
AnyRequest = TypeVar("AnyRequest", bound="Request")
AnyChecked = TypeVar("AnyChecked", bound="Checked")


class Checked(Protocol):
    """A record of a command line whose values can be out of range."""

    def check(self) -> None:
        """Raises ValueError, which names the field, for values that are out of range; reads no files."""
        ...


class Request(Protocol):
    """What a program or a user asks for; the records of this package are such dataclasses."""

    def check(self) -> None:
        """Raises ValueError, which names the field, for values that are out of range; reads no files."""
        ...

    def run(self, session: Session, report: Report) -> dict[str, Any]:
        """Does the work; the result is JSON-RPC's (docs/design/protocol.md). `report` may raise to stop."""
        ...


class RequestError(ValueError):
    """Parameters that are unknown, missing or of another type; the message names the first."""


def read_request(record: type[AnyRequest], params: dict[str, Any], method: str) -> AnyRequest:
    """The request in a JSON object. Raises RequestError, and ValueError where `check` does."""
    request = read_record(record, params, method)
    request.check()
    return request


def read_record(record: type[R], params: dict[str, Any], name: str) -> R:
    """A dataclass of a JSON object's values; `name` is what errors call the object. Raises RequestError.

    Fields may be bool, int, float, str, Path (a text that is not empty), Literal, list (of anything), list[T],
    tuple[T, ...], dict[str, T], dataclasses and unions of these. A dataclass that has `from_json` reads itself.
    """
    fields = {field.name: field for field in dataclasses.fields(record)}  # type: ignore[arg-type]
    if unknown := sorted(set(params) - set(fields)):
        known = ", ".join(fields) or "none"
        raise RequestError(f"{name!r} does not know the parameter {unknown[0]!r}: its parameters are {known}")
    for field in fields.values():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and field.name not in params:
            raise RequestError(f"{name!r} needs the parameter {field.name!r}: it was not given")
    hints = typing.get_type_hints(record)
    return record(**{key: _value(hints[key], value, f"{name}.{key}") for key, value in params.items()})


def _value(kind: Any, value: Any, name: str) -> Any:
    """`value` as the type `kind`. Raises RequestError."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        return _one_of(arguments, value, name)
    if origin is Literal and isinstance(value, str) and value in arguments:
        return value
    if origin in (list, tuple) and isinstance(value, list):
        return origin(_value(arguments[0], entry, f"{name}[{i}]") for i, entry in enumerate(value))
    if origin is dict and isinstance(value, dict):
        return {key: _value(arguments[1], entry, f"{name}[{key!r}]") for key, entry in value.items()}
    if dataclasses.is_dataclass(kind) and hasattr(kind, "from_json"):
        return kind.from_json(value, name)  # type: ignore[attr-defined]
    if dataclasses.is_dataclass(kind) and isinstance(value, dict):
        return read_record(kind, value, name)  # type: ignore[arg-type]
    if kind is Path and isinstance(value, str) and value:
        return Path(value)
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        return value
    if kind in (bool, int, str, list, types.NoneType) and type(value) is kind:
        return value
    raise RequestError(f"{name} must be {_in_words(kind)}: {value!r:.80} was given")


def _one_of(kinds: Sequence[Any], value: Any, name: str) -> Any:
    for kind in kinds:
        with contextlib.suppress(RequestError):
            return _value(kind, value, name)
    raise RequestError(f"{name} must be {' or '.join(map(_in_words, kinds))}: {value!r:.80} was given")


_WORDS = {
    Path: "the path of a file or folder",
    types.NoneType: "null",
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
    list: "a list",
    tuple: "a list",
    dict: "a JSON object",
}


def _in_words(kind: Any) -> str:
    if typing.get_origin(kind) is Literal:
        return "one of " + ", ".join(map(repr, typing.get_args(kind)))
    return _WORDS.get(typing.get_origin(kind) or kind, "a JSON object")


def parse(record: type[AnyChecked], arguments: Sequence[str], command: str) -> AnyChecked:
    """The request in a command line; ends the process with 2 for wrong usage. Raises ValueError where `check` does."""
    request = tyro.cli(record, args=arguments, prog=f"primdiffusion {command}")
    request.check()
    return request


def _words_to_attributes(words: list[str]) -> dict[str, Any]:
    """NAME=VALUE words by name; what is wrong with them `checks.check_attributes` says, as of other requests."""
    attributes: dict[str, Any] = {}
    for word in words:
        name, _, value = word.partition("=")
        attributes[name] = value if name not in attributes else [attributes[name], value]
    return attributes


OutDir = Annotated[Path, tyro.conf.arg(name="out")]
"""A folder that is `out_dir` in JSON and --out on the command line."""
Attributes = Annotated[
    dict[str, str | float],
    tyro.constructors.PrimitiveConstructorSpec(
        nargs="*",
        metavar="NAME=VALUE",
        instance_from_str=_words_to_attributes,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=lambda attributes: [f"{name}={value}" for name, value in attributes.items()],
    ),
]
"""What a person shall be: an object in JSON, NAME=VALUE words on the command line."""
