"""Sentences on errors."""

import pytest

from blender_primdiffusion.backend.requests import error_text, sentence
from blender_primdiffusion.console import Report, separate_stdout
from blender_primdiffusion.ui import drawing

pytestmark = pytest.mark.any_blender


ESCAPE = "\x1b]0;owned\x07\x1b[2J\u202egnp.exe"


def test_no_terminal_escape_leaves_in_a_sentence_a_line_or_a_report(capfd):
    for error in (FileNotFoundError(2, "No such file", ESCAPE), ValueError(f"{ESCAPE}\n"), ESCAPE):
        assert sentence(error).isprintable()
        assert "owned" in error_text(error)
    assert all(line.isprintable() for line in drawing._wrapped(f"It is {ESCAPE}", 40))
    with separate_stdout() as say:
        say(f"{ESCAPE}: damaged")
    said = capfd.readouterr().out
    assert said.rstrip("\n").isprintable()
    assert "owned" in said
    assert Report().fail("anna", "capture", ESCAPE).isprintable()
