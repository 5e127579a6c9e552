"""Sentences on errors."""

import pytest
from jobs_driven import Layout

from blender_primdiffusion.backend.requests import error_text, sentence
from blender_primdiffusion.console import Report, separate_stdout
from blender_primdiffusion.ui.drawing import draw_lines

pytestmark = pytest.mark.any_blender


ESCAPE = "\x1b]0;owned\x07\x1b[2J\u202egnp.exe"


def test_a_sentence_keeps_the_case_of_a_files_name():
    for text in ("anna.bvh does not exist: check the path", "anna/walks is a folder", PermissionError(1, "No", "anna")):
        assert sentence(text).startswith("anna")
    assert sentence("no room is left") == "No room is left."


def test_no_terminal_escape_leaves_in_a_sentence_a_line_or_a_report(capfd):
    for error in (FileNotFoundError(2, "No such file", ESCAPE), ValueError(f"{ESCAPE}\n"), ESCAPE):
        assert sentence(error).isprintable()
        assert "owned" in error_text(error)
    layout = Layout()
    draw_lines(layout, f"It is {ESCAPE}", "ERROR")
    assert all(line.isprintable() for line in layout.of("text"))
    assert "owned" in "".join(layout.of("text"))
    with separate_stdout() as say:
        say(f"{ESCAPE}: damaged")
    said = capfd.readouterr().out
    assert said.rstrip("\n").isprintable()
    assert "owned" in said
    assert Report().fail("anna", "capture", ESCAPE).isprintable()
