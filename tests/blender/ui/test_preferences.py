"""The viewer's backend, which the user installs: found, named in the preferences, or missing with what to do."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import MagicMock

import pytest

from blender_primdiffusion.backend.environment import VARIABLE
from blender_primdiffusion.ui import preferences

pytestmark = pytest.mark.any_blender


@pytest.fixture
def alone(addon, monkeypatch):
    """The viewer, and no backend anywhere."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(preferences, "setup", None)
    monkeypatch.setattr(preferences, "_own_python_will_do", lambda: False)
    monkeypatch.setattr(preferences, "installed_backend", lambda: None)


def test_without_a_backend_the_panel_says_what_to_do_and_opens_the_preferences(alone):
    layout = MagicMock()
    assert not preferences.draw_set_up(layout)
    assert layout.box().operator.call_args.args == ("preferences.addon_show",)
    assert preferences.known().line.startswith("There is no backend on this computer: install")


def test_a_program_on_the_path_is_found_and_one_in_the_preferences_goes_first(alone, monkeypatch):
    monkeypatch.setattr(preferences, "installed_backend", lambda: Path("/opt/primdiffusion"))
    assert preferences.draw_set_up(MagicMock())
    assert preferences.known().line == "Uses /opt/primdiffusion, named by the PATH"
    monkeypatch.setattr(preferences, "preference", lambda _name: "/mine/bin/python")
    assert preferences.known().line == "Uses /mine/bin/python, named by the extension's preferences"
