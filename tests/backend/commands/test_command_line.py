"""Command lines of declared records: options, help and errors come from the declaration."""

import dataclasses
import re
from pathlib import Path
from typing import Annotated

import pytest
from primdiffusion.commands.command_line import parse
from primdiffusion.commands.options import OPTIONS
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
