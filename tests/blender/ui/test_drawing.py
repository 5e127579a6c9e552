"""Text wrapped in panels."""

from __future__ import annotations

import pytest

from blender_primdiffusion.ui import drawing

pytestmark = pytest.mark.any_blender


def test_numbers_keep_their_units_where_lines_break():
    lines = drawing._wrapped("Generated in 47.6 s, and after that built in 2.9 s.")
    assert not any(line.startswith(("s,", "s.")) for line in lines)
    assert " ".join(lines) == "Generated in 47.6 s, and after that built in 2.9 s."
    assert max(map(len, lines)) <= drawing._LINE
