"""Command lines of declared records: options, help and errors come from the declaration."""

import dataclasses
import re
from pathlib import Path
from typing import Annotated

import pytest
from primdiffusion.commands import progress as module
from primdiffusion.commands.command_line import parse
from primdiffusion.commands.options import OPTIONS
from primdiffusion.commands.progress import EtaEstimator
from primdiffusion.formats.requests import Attributes, GenerateRequest
from primdiffusion.formats.schema import FieldError, Option, Range


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Settle something."""

    source: Annotated[Path, Option(positional=True)]
    out_dir: Annotated[Path, Option(name="out")]
    level: Annotated[int, Range(2, 77)] = 7
    """The level of noise."""
    secret: Annotated[int, Option(hidden=True)] = 3
    attributes: Attributes = dataclasses.field(default_factory=dict)


def test_a_record_is_read_from_its_options():
    line = ["a.human", "--out", "there", "--level", "77", "--attributes", "sex=female", "outfit=blouse and skirt"]
    attributes = {"sex": "female", "outfit": "blouse and skirt"}
    expected = Settings(source=Path("a.human"), out_dir=Path("there"), level=77, attributes=attributes)
    read = parse(Settings, line, "settle")
    assert read == expected
    assert type(read) is Settings


def test_help_has_the_description_and_the_limits(capsys):
    with pytest.raises(SystemExit) as end:
        parse(Settings, ["--help"], "settle")
    assert end.value.code == 0
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "usage: primdiffusion settle" in shown
    assert "Settle something." in shown
    assert "The level of noise. From 2 to 77. (default: 7)" in shown
    assert "--secret" not in shown


@pytest.mark.parametrize(
    "words",
    [["--level", "x"], ["--attributes", "tall"], ["--attributes", "a="], ["--attributes", "a=1", "a=2"], ["--no"]],
)
def test_what_is_no_value_is_a_usage_error(words, capsys):
    with pytest.raises(SystemExit) as end:
        parse(Settings, ["a", "--out", "b", *words], "settle")
    assert end.value.code == 2


@pytest.mark.parametrize("level", ["1", "78"])
def test_a_value_out_of_range_is_named(level):
    with pytest.raises(FieldError) as error:
        parse(Settings, ["a", "--out", "b", "--level", level], "settle")
    assert error.value.field == "level"


def test_the_last_seed_is_within_the_limit_too():
    line = ["--out", "o", "--count", "2", "--seed"]
    assert parse(GenerateRequest, [*line, str(2**63 - 2)], "generate").count == 2
    with pytest.raises(FieldError) as error:
        parse(GenerateRequest, [*line, str(2**63 - 1)], "generate")
    assert error.value.field == "count"


@pytest.mark.parametrize("name", OPTIONS)
def test_every_command_has_help(name, capsys):
    with pytest.raises(SystemExit) as end:
        parse(OPTIONS[name], ["--help"], name)
    assert end.value.code == 0
    assert not re.search(r"\d{12}|\de[+]\d|Posix|Windows(Path|Posix)", capsys.readouterr().out), "limits nobody reaches"


def paced(monkeypatch, steps: list[float]) -> list[float | None]:
    """Estimates after steps of these seconds."""
    now, pace, found = 0.0, EtaEstimator(), []
    for done, step in enumerate(steps, 1):
        now += step
        monkeypatch.setattr(module.time, "perf_counter", lambda now=now: now)
        found.append(pace.left(done, len(steps)))
    return found


def test_the_time_left_leaves_out_loading_and_compiling(monkeypatch):
    steps = [90.0, 4.0, 60.0, 4.0, 5.0, *([4.0] * 25)]  # the marcher is compiled for a preview in the third
    found = paced(monkeypatch, steps)
    assert found[:2] == [None, None]
    for done in range(3, len(steps)):
        assert found[done - 1] == pytest.approx(sum(steps[done:]), rel=0.15)
    assert found[-1] == 0


def test_the_time_left_follows_a_machine_that_becomes_slow(monkeypatch):
    found = paced(monkeypatch, [1.0] * 20 + [10.0] * 20)
    assert found[18] == pytest.approx(21)
    assert found[30] == pytest.approx(90)


def test_a_single_step_leaves_nothing_to_wait_for(monkeypatch):
    assert paced(monkeypatch, [30.0]) == [0]
