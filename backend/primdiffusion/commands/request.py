"""Requests: frozen records read from JSON or a command line, their checks and progress. Imports no torch."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import itertools
import math
import os
import statistics
import time
import types
import typing
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, TypeVar

import tyro
from tqdm import tqdm

from primdiffusion.formats.json_files import LARGEST_INTEGER

if TYPE_CHECKING:
    from primdiffusion.commands.session import Session
    from primdiffusion.diffusion.samplers import SamplerStep

R = TypeVar("R")
AnyRequest = TypeVar("AnyRequest", bound="RequestRecord")
AnyChecked = TypeVar("AnyChecked", bound="Checked")
STEP_LIMIT = 1000
"""The schedule's length: a sampler cannot take more steps."""
LARGEST_PREVIEW = 1024
"""Pixels a side: a larger one would delay sampling and cancelling."""
LARGEST_GUIDANCE = 100
LARGEST_SIDE = 65_536
"""Pixels of a picture."""
LARGEST_NUMBER = 1e30
"""Products of larger numbers overflow float32."""


class Checked(Protocol):
    """A record of a command line with values to check."""

    def check(self) -> None:
        """Raise ValueError, naming the field, for values out of range; reads no files."""
        ...


class ReportProgress(Protocol):
    """Receives the progress of a running request."""

    def __call__(self, stage: str, step: int, total: int, eta_s: float | None, /, **more: Any) -> None:
        """`eta_s`: seconds left; `more`: `picture`, a preview's path, and `index`, its sample. May raise to cancel."""
        ...


class RequestRecord(Checked, Protocol):
    """A request of a program or a user; the records of this package are such dataclasses."""

    def run(self, session: Session, report: ReportProgress) -> dict[str, Any]:
        """Run the request; the result is that of JSON-RPC (docs/design/protocol.md). `report` may raise to cancel."""
        ...


class ParameterError(ValueError):
    """A parameter that is unknown, missing or of a wrong type; the message names it."""


def read_request(record: type[AnyRequest], params: dict[str, Any], method: str) -> AnyRequest:
    """Read and check a request. Raises ParameterError for a wrong parameter and ValueError for values out of range."""
    request = read_record(record, params, method)
    request.check()
    return request


def read_record(record: type[R], params: dict[str, Any], name: str) -> R:
    """Read a dataclass from a JSON object, called `name` in errors. Raises ParameterError.

    Fields may be bool, int, float, str, Path (a non-empty string), Literal, list (of anything), list[T],
    tuple[T, ...], dict[str, T], dataclasses and unions of these. A dataclass with a method `from_json` reads itself.
    """
    fields = {field.name: field for field in dataclasses.fields(record)}  # type: ignore[arg-type]
    if unknown := sorted(set(params) - set(fields)):
        known = ", ".join(fields) or "none"
        raise ParameterError(f"{name!r} does not know the parameter {unknown[0]!r:.60}: its parameters are {known}")
    for field in fields.values():
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if required and field.name not in params:
            raise ParameterError(f"{name!r} needs the parameter {field.name!r}: it was not given")
    hints = typing.get_type_hints(record)
    return record(**{key: _value(hints[key], value, f"{name}.{key}") for key, value in params.items()})


def _value(kind: Any, value: Any, name: str) -> Any:
    """Convert `value` to the type `kind`. Raises ParameterError."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        return _one_of(arguments, value, name)
    if origin is Literal and isinstance(value, str) and value in arguments:
        return value
    if origin in (list, tuple) and isinstance(value, list):
        return origin(_value(arguments[0], entry, f"{name}[{i}]") for i, entry in enumerate(value))
    if origin is dict and isinstance(value, dict):
        return {key: _value(arguments[1], entry, f"{name}[{key!r:.60}]") for key, entry in value.items()}
    if dataclasses.is_dataclass(kind) and hasattr(kind, "from_json"):
        return kind.from_json(value, name)  # type: ignore[attr-defined]
    if dataclasses.is_dataclass(kind) and isinstance(value, dict):
        return read_record(kind, value, name)  # type: ignore[arg-type]
    if kind is Path and isinstance(value, str) and value and "\0" not in value:
        with contextlib.suppress(UnicodeEncodeError):  # half a character
            os.fsencode(value)
            return Path(value)
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        if not -LARGEST_NUMBER <= value <= LARGEST_NUMBER:
            raise ParameterError(f"{name} is {value!r:.40}: give a finite number, of at most {LARGEST_NUMBER:g}")
        return value
    if kind in (bool, int, str, list, types.NoneType) and type(value) is kind:
        return value
    if kind is int and isinstance(value, float) and abs(value) > LARGEST_INTEGER:  # a longer integer, see `json_files`
        raise ParameterError(f"{name} is {value:.6g}: integers go {'up to 2^63-1' if value > 0 else 'down to 1-2^63'}")
    raise ParameterError(f"{name} must be {_in_words(kind)}: {value!r:.80} was given")


def _one_of(kinds: Sequence[Any], value: Any, name: str) -> Any:
    for kind in kinds:
        with contextlib.suppress(ParameterError):
            return _value(kind, value, name)
    raise ParameterError(f"{name} must be {' or '.join(map(_in_words, kinds))}: {value!r:.80} was given")


_WORDS = {
    Path: "the path of a file or folder",
    types.NoneType: "null",
    bool: "true or false",
    int: "an integer",
    float: "a number",
    str: "a string",
    list: "a list",
    tuple: "a list",
    dict: "a JSON object",
}


def _in_words(kind: Any) -> str:
    if typing.get_origin(kind) is Literal:
        return "one of " + ", ".join(map(repr, typing.get_args(kind)))
    return _WORDS.get(typing.get_origin(kind) or kind, "a JSON object")


def parse(record: type[AnyChecked], arguments: Sequence[str], command: str) -> AnyChecked:
    """Read and check a command line; exits with 2 for a usage error, raises ValueError for values out of range."""
    request = tyro.cli(record, args=arguments, prog=f"primdiffusion {command}")
    request.check()
    return request


def _words_to_attributes(words: list[str]) -> dict[str, Any]:
    """Parse NAME=VALUE arguments; `check_attributes` validates them, as those in JSON."""
    attributes: dict[str, Any] = {}
    for word in words:
        name, _, value = word.partition("=")
        attributes[name] = value if name not in attributes else [attributes[name], value]
    return attributes


OutDir = Annotated[Path, tyro.conf.arg(name="out")]
"""An output folder: `out_dir` in JSON, --out on the command line."""
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
"""Attributes of a human: an object in JSON, NAME=VALUE arguments on the command line."""


_PACED_BY = 10
"""Steps."""
_UNUSUAL = 3.0
"""Times the median: previews make a step longer, but less so."""


class Pace:
    """Estimates the time left from the last steps, without the first and those that take far longer than most: they
    load and compile."""

    def __init__(self) -> None:
        self._times: collections.deque[float] = collections.deque(maxlen=_PACED_BY + 1)

    def left(self, done: int, total: int) -> float | None:
        """Return the seconds until `total`; call it after each step. None after the first two, unless it is 0."""
        self._times.append(time.perf_counter())
        if done >= total:
            return 0.0
        if len(self._times) < 3:
            return None
        steps = [after - before for before, after in itertools.pairwise(self._times)]
        usual = [step for step in steps if step <= _UNUSUAL * statistics.median_low(steps)]
        return round(statistics.mean(usual) * (total - done), 3)


def step_reporter(
    report: ReportProgress, picture: Callable[[SamplerStep], str | None]
) -> Callable[[SamplerStep], None]:
    """Return a function that reports a step with the seconds left and the path of its preview, if it has one."""
    pace = Pace()

    def on_step(step: SamplerStep) -> None:
        path = picture(step)
        more = {} if path is None else {"picture": path}
        done = step.index + 1
        report("sample", done, step.total, pace.left(done, step.total), **more)

    return on_step


@contextlib.contextmanager
def progress_bar(label: str | None = None) -> Iterator[ReportProgress]:
    """Show the sampler's steps on stderr, if that is a terminal."""
    with tqdm(desc=label, unit="step", disable=None) as bar:

        def report(stage: str, step: int, total: int, _eta_s: float | None, /, **_more: Any) -> None:
            if stage == "sample":
                bar.total = total
                bar.update(step - bar.n)

        yield report


def check_steps(steps: int) -> None:
    """Raise ValueError outside 1 ... STEP_LIMIT."""
    if not 1 <= steps <= STEP_LIMIT:
        raise ValueError(f"{steps} steps were requested: choose 1 to {STEP_LIMIT}")


def check_size(size: int) -> None:
    """Raise ValueError for a picture that is empty or larger than LARGEST_SIDE."""
    if not 1 <= size <= LARGEST_SIDE:
        raise ValueError(f"size is {size} pixels: choose 1 to {LARGEST_SIDE}")


def check_sides(width: int, height: int) -> None:
    """Raise ValueError for a picture that is empty or larger than LARGEST_SIDE."""
    if min(width, height) < 1 or max(width, height) > LARGEST_SIDE:
        raise ValueError(f"the image size is {width} x {height} pixels: choose sides of 1 to {LARGEST_SIDE}")


def check_ending(path: Path | None, *endings: str) -> None:
    """Raise ValueError for a file of another kind: a human that is named by mistake would be overwritten."""
    if path is not None and path.suffix.lower() not in endings:
        raise ValueError(f"{path.name!r:.80} has none of the extensions {', '.join(endings)}: choose one")


def check_picture_px(picture_px: int) -> None:
    """Raise ValueError outside 0 ... LARGEST_PREVIEW."""
    if not 0 <= picture_px <= LARGEST_PREVIEW:
        raise ValueError(f"picture_px is {picture_px}: choose 0, for no previews, to {LARGEST_PREVIEW}")


def check_attributes(attributes: dict[str, Any], guidance: float) -> None:
    """Raise ValueError unless all values are strings or finite numbers; the model checks which of them it knows."""
    for name, value in attributes.items():
        if not name or value == "":
            raise ValueError(
                f"{name or value!r} is not an attribute: write NAME=VALUE, as in outfit=suit or height=1.8"
            )
        if isinstance(value, list):
            raise ValueError(f"the attribute {name!r} is given twice: give it once")
        number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST_NUMBER
        if not (isinstance(value, str) or number):
            raise ValueError(f"the attribute {name!r} is {value!r:.40}: give a string or a number")
    if not abs(guidance) <= LARGEST_GUIDANCE:
        raise ValueError(f"guidance is {guidance}: give a number up to {LARGEST_GUIDANCE}, 1 for none")


SMALLEST_VOXEL, LARGEST_VOXEL = 1e-4, 10.0
"""Metres."""


def check_voxel(voxel: float) -> None:
    """Raise ValueError unless this is a positive length."""
    if not SMALLEST_VOXEL <= voxel <= LARGEST_VOXEL:
        raise ValueError(
            f"voxel is {voxel}: give the side of a voxel in metres, {SMALLEST_VOXEL} to {LARGEST_VOXEL} and above zero"
        )


def check_angle(name: str, angle: float, unit: str) -> None:
    """Raise ValueError for NaN and infinite angles."""
    if not math.isfinite(angle):
        raise ValueError(f"{name} is {angle}: give an angle in {unit}")


def check_betas(betas: list | None) -> None:
    """Raise ValueError unless this is None or a list of numbers."""
    if betas is not None:
        check_numbers("betas", betas, (len(betas),))


def check_numbers(name: str, value: Any, shape: tuple[int, ...]) -> None:
    """Raise ValueError unless `value` holds numbers that fit into float32, in nested lists of this shape."""
    if not shape:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{name} holds {value!r:.40} instead of a number")
        if not -LARGEST_NUMBER <= value <= LARGEST_NUMBER:
            raise ValueError(f"{name} holds {value!r:.40}: give finite numbers, of at most {LARGEST_NUMBER:g}")
        return
    if not isinstance(value, list) or len(value) != shape[0]:
        given = f"{len(value)} entries" if isinstance(value, list) else f"{value!r:.40}"
        raise ValueError(f"{name} holds {given} instead of {' x '.join(map(str, shape))} numbers")
    for entry in value:
        check_numbers(name, entry, shape[1:])
