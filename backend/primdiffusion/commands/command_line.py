"""Command lines of declared records (`formats.requests`, `commands.options`): their options, help and checks."""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Sequence
from typing import Annotated, Any, TypeVar, get_args, get_origin

import tyro

from primdiffusion.commands import function_of, open_session
from primdiffusion.commands.options import OPTIONS
from primdiffusion.commands.progress import progress_bar, show
from primdiffusion.formats.schema import Option, Range, descriptions, field_types, read, split

Record = TypeVar("Record")
_HUGE = 1e18
"""Limits beyond this are those of the computer, not of the option."""


def run_record(name: str, arguments: Sequence[str]) -> None:
    """Run a subcommand of `OPTIONS` as the child runs a request, and print its answer; raises its errors."""
    request = parse(OPTIONS[name], arguments, name)
    function = function_of(name)
    with progress_bar() as report:
        answer = function(request, open_session(), report)
    show(answer)


def parse(record: type[Record], arguments: Sequence[str], command: str) -> Record:
    """Read a command line; exits with 2 for a usage error, raises FieldError for values out of range."""
    given = tyro.cli(_with_options(record), args=arguments, prog=f"primdiffusion {command}")
    return read(record, vars(given))


def _with_options(record: type) -> type:
    """A record of the fields that the command line has, with annotations that tyro understands."""
    about, fields = descriptions(record), []
    for field in dataclasses.fields(record):
        kind = field_types(record)[field.name]
        if Option(hidden=True) not in split(kind)[1]:
            default = dataclasses.field(default=field.default, default_factory=field.default_factory)
            fields.append((field.name, _with_option(kind, about.get(field.name, "")), default))
    options = dataclasses.make_dataclass(record.__name__, fields, kw_only=True)
    options.__doc__ = record.__doc__
    return options


def _with_option(kind: Any, about: str) -> Any:
    plain, marks = split(kind)
    option = next((mark for mark in marks if isinstance(mark, Option)), Option())
    if get_origin(plain) is dict:
        plain = Annotated[plain, _NAMES_AND_VALUES]
    if option.positional:
        plain = tyro.conf.Positional[plain]
    if list in get_args(plain):  # numbers come in files
        plain = functools.reduce(operator.or_, (part for part in get_args(plain) if part is not list))
    words = " ".join([about, *(_limits(mark) for mark in marks if isinstance(mark, Range))]).strip()
    return Annotated[plain, tyro.conf.arg(name=option.name or None, help=words)]


def _limits(mark: Range) -> str:
    """A sentence of help on the limits of a number, without those that no input reaches."""
    if mark.least <= -_HUGE:
        return ""
    shown = Range(mark.least) if mark.most >= _HUGE else mark
    return f"{str(shown).capitalize()}."


def _names_and_values(words: list[str]) -> dict[str, Any]:
    """Parse NAME=VALUE arguments. Raises ValueError."""
    values: dict[str, Any] = {}
    for word in words:
        name, _, value = word.partition("=")
        if not name or not value:
            raise ValueError(f"{word!r} is not an attribute: write NAME=VALUE, as in outfit=suit or height=1.8")
        if name in values:
            raise ValueError(f"the attribute {name!r} is given twice: give it once")
        values[name] = value
    return values


_NAMES_AND_VALUES = tyro.constructors.PrimitiveConstructorSpec(
    nargs="*",
    metavar="NAME=VALUE",
    instance_from_str=_names_and_values,
    is_instance=lambda value: isinstance(value, dict),
    str_from_instance=lambda values: [f"{name}={value}" for name, value in values.items()],
)
