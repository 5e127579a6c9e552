"""Declared records: dataclasses whose annotations say which values a message or a command line may hold.

    @dataclass(frozen=True, kw_only=True)
    class GenerateRequest:
        seed: Annotated[int, Range(0, 2**63 - 1)]
        out: Annotated[Path, Ending(".png")]
        sampler: Literal["ddim", "ddpm"] = "ddim"

`read` makes a record of untrusted values, `written` the JSON of a record. A record's method `check`, if it has one,
compares fields with each other. Needs no numpy: both programs declare and read their messages with it.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import functools
import inspect
import itertools
import math
import sys
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from ..files.json_files import LARGEST_INTEGER

Record = TypeVar("Record")
Names = tuple[str | int, ...]
LONGEST_TEXT = 8192
"""Characters of a string or a path."""


class FieldError(ValueError):
    """A value that its field does not allow. The message names the field, the value, and what to give instead."""

    def __init__(self, path: Names, problem: str):
        self.path, self.problem = path, problem
        self.field = "".join(map(_part, path)).removeprefix(".")
        super().__init__(path, problem)  # by which it is pickled

    def __str__(self) -> str:
        return f"{self.field or 'it'} {self.problem}"


def _part(name: str | int) -> str:
    if isinstance(name, int):
        return f"[{name}]"
    return f".{name}" if name.isidentifier() else f".{name!r:.60}"


class Open:
    """Base of records that leave out values which they do not declare: a newer program may have sent them."""


class Limit:
    """An annotation of a field; its text follows the name of the type in errors: "an integer from 1 to 1000"."""

    def allows(self, value: Any) -> bool:
        """Whether a value of the right type is allowed."""
        raise NotImplementedError


@dataclasses.dataclass(frozen=True)
class Range(Limit):
    """Limits of a number, both allowed; NaN is in no range."""

    least: float = -math.inf
    most: float = math.inf

    def allows(self, value: float) -> bool:
        return self.least <= value <= self.most

    def __str__(self) -> str:
        if self.most == math.inf:
            return f"of at least {_number(self.least)}"
        return f"from {_number(self.least)} to {_number(self.most)}"


def _number(limit: float) -> str:
    """A limit as people write it: 2^63 - 1, not its 19 digits."""
    if not isinstance(limit, int):
        return f"{limit:g}"
    bits = limit.bit_length()
    if bits < 54 or abs(limit) != 2**bits - 1:
        return str(limit)
    return f"2^{bits} - 1" if limit > 0 else f"-2^{bits} + 1"


@dataclasses.dataclass(frozen=True)
class Length(Limit):
    """Limits of the number of entries or characters, both allowed."""

    least: int
    most: float = math.inf

    def allows(self, value: Any) -> bool:
        return self.least <= len(value) <= self.most

    def __str__(self) -> str:
        return f"of length {self.least} or more" if self.most == math.inf else f"of length {self.least} to {self.most}"


@dataclasses.dataclass(frozen=True)
class Shape(Limit):
    """Sides of an array of numbers in nested lists."""

    sides: tuple[int, ...]

    def allows(self, value: Any) -> bool:
        return _is_array(value, self.sides)

    def __str__(self) -> str:
        return f"of {' x '.join(map(str, self.sides))} numbers, none beyond {_REAL.most:g}"


@dataclasses.dataclass(frozen=True)
class Ending(Limit):
    """Extensions, in lower case, that the name of a file may have."""

    endings: tuple[str, ...]

    def allows(self, value: Any) -> bool:
        return Path(value).suffix.lower() in self.endings

    def __str__(self) -> str:
        return f"with the extension {' or '.join(self.endings)}"


@dataclasses.dataclass(frozen=True)
class Slider:
    """The part of a range that a slider covers."""

    least: float
    most: float


@dataclasses.dataclass(frozen=True)
class Option:
    """Form of a field on the command line, if it is not an option of its own name."""

    name: str = ""
    positional: bool = False
    hidden: bool = False


_WHOLE = Range(-LARGEST_INTEGER, LARGEST_INTEGER)
_REAL = Range(-1e30, 1e30)
"""Products of larger numbers overflow float32."""
_NAMES = {
    bool: "true or false",
    int: "an integer",
    float: "a number",
    str: "a string",
    Path: "the path of a file or folder",
    list: "a list",
    tuple: "a list",
}


def read(record: type[Record], values: Mapping[str, Any], *path: str | int) -> Record:
    """Make a record of values of JSON or of a command line. Raises FieldError, whose fields begin with `path`."""
    known = field_types(record)
    if not isinstance(values, Mapping):
        raise FieldError(path, f"is {values!r:.80}: give an object")
    if (unknown := sorted(set(values) - set(known))) and not issubclass(record, Open):
        raise FieldError((*path, unknown[0]), f"is unknown: choose from {', '.join(known) or 'no fields'}")
    for field in dataclasses.fields(record):  # type: ignore[arg-type]
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and field.name not in values:
            raise FieldError((*path, field.name), f"is missing: give {_expected(known[field.name])}")
    made = record(**{name: _value(known[name], values[name], (*path, name)) for name in known if name in values})
    check = getattr(made, "check", None)
    if check is not None:
        try:
            check()
        except FieldError as error:
            raise FieldError((*path, *error.path), error.problem) from None
    return made


def check(record: Any) -> None:
    """Raise FieldError for a field of a record that was not `read`, whose value its annotation does not allow."""
    for name, kind in field_types(type(record)).items():
        _value(kind, getattr(record, name), (name,))


class Checked:
    """Base of records that make sure of their fields themselves, as `check` does."""

    def __post_init__(self) -> None:
        check(self)


def written(value: Any) -> Any:
    """The JSON of a record or of a field's value."""
    if dataclasses.is_dataclass(value):
        return {field.name: written(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, list | tuple):
        return [written(entry) for entry in value]
    return str(value) if isinstance(value, Path) else value


@functools.cache
def field_types(record: type) -> dict[str, Any]:
    """Types of a record's fields by name, with their limits."""
    hints = typing.get_type_hints(record, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(record)}


@functools.cache
def descriptions(record: type) -> dict[str, str]:
    """The strings below the fields of a record, each as one line."""
    found: dict[str, str] = {}
    for base in [base for base in reversed(record.__mro__) if dataclasses.is_dataclass(base)]:
        for field, below in itertools.pairwise(_classes(base.__module__)[base.__name__].body):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
                found[ast.unparse(field.target)] = " ".join(ast.literal_eval(below.value).split())
    return found


@functools.cache
def _classes(module: str) -> dict[str, ast.ClassDef]:
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


def split(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    """The type of an annotation, and its limits and other marks."""
    if typing.get_origin(kind) is Annotated:
        return kind.__origin__, kind.__metadata__
    return kind, {int: (_WHOLE,), float: (_REAL,)}.get(kind, ())


def _value(kind: Any, value: Any, path: Names) -> Any:
    """Convert `value` to the type `kind`. Raises FieldError."""
    plain, marks = split(kind)
    origin, arguments = typing.get_origin(plain) or plain, typing.get_args(plain)
    if origin in (types.UnionType, typing.Union):
        return _one_of(plain, value, path)
    if not _is(plain, value) or not all(mark.allows(value) for mark in marks if isinstance(mark, Limit)):
        raise FieldError(path, f"is {written(value)!r:.80}: give {_expected(kind)}")
    if dataclasses.is_dataclass(plain):
        return read(plain, value if isinstance(value, dict) else vars(value), *path)  # type: ignore[arg-type]
    if origin in (list, tuple) and arguments:
        return origin(_value(arguments[0], entry, (*path, index)) for index, entry in enumerate(value))
    if origin is dict and arguments:
        return {_value(arguments[0], k, (*path, k)): _value(arguments[1], v, (*path, k)) for k, v in value.items()}
    return plain(value) if plain in (int, Path) else value


def _one_of(union: Any, value: Any, path: Names) -> Any:
    kinds = _alternatives(union)
    if value is None and len(kinds) < len(typing.get_args(union)):
        return None
    if len(kinds) == 1:
        return _value(kinds[0], value, path)
    for kind in kinds:
        with contextlib.suppress(FieldError):
            return _value(kind, value, path)
    raise FieldError(path, f"is {written(value)!r:.80}: give {_expected(union)}")


def _alternatives(union: Any) -> list[Any]:
    """The types of a union besides None."""
    return [kind for kind in typing.get_args(union) if kind is not types.NoneType]


def _expected(kind: Any) -> str:
    """Description of a field's values, for an error: "an integer from 1 to 1000"."""
    plain, marks = split(kind)
    origin = typing.get_origin(plain) or plain
    if origin in (types.UnionType, typing.Union):
        return " or ".join(map(_expected, _alternatives(plain)))
    if origin is Literal:
        return f"one of {', '.join(map(repr, typing.get_args(plain)))}"
    return " ".join([_NAMES.get(origin, "an object"), *(str(mark) for mark in marks if isinstance(mark, Limit))])


def _is(plain: Any, value: Any) -> bool:
    """Whether a value of JSON or of a command line can become one of this type."""
    origin = typing.get_origin(plain) or plain
    if origin is Literal:
        return isinstance(value, str) and value in typing.get_args(plain)
    if dataclasses.is_dataclass(plain):
        return isinstance(value, dict | plain)  # type: ignore[operator]
    if origin is int and isinstance(value, float):  # a longer integer, see `json_files`
        return value.is_integer() and abs(value) > LARGEST_INTEGER
    if origin in (int, float):
        return isinstance(value, int | float) and not isinstance(value, bool)
    if origin is str:
        return isinstance(value, str) and _is_text(value, "strict")
    if origin is Path:
        return isinstance(value, str | Path) and value != "" and _is_text(str(value), "surrogateescape")
    return isinstance(value, list | tuple if origin in (list, tuple) else origin)


def _is_text(text: str, halves: Literal["strict", "surrogateescape"]) -> bool:
    """Whether the system can hold a text; `halves` of characters stand for the bytes of names that are not UTF-8."""
    with contextlib.suppress(UnicodeEncodeError):
        return len(text.encode("utf-8", halves)) <= 4 * LONGEST_TEXT and "\0" not in text
    return False


def _is_array(value: Any, sides: tuple[int, ...]) -> bool:
    if not sides:
        return _is(float, value) and _REAL.allows(value)
    return isinstance(value, list) and len(value) == sides[0] and all(_is_array(entry, sides[1:]) for entry in value)
