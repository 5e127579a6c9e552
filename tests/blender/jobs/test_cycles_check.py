"""Cycles that leaves volumes empty is found out once, by a child, while Blender goes on."""

from __future__ import annotations

import subprocess
import sys
import time
from types import SimpleNamespace

import bpy
import pytest
from jobs_driven import shown

from blender_primdiffusion.jobs import cycles_check
from blender_primdiffusion.ui import render_panel

FAULT = "draws volumes empty"


@pytest.fixture
def debian(addon, tmp_path, monkeypatch):
    """A Blender in whose place a program stands that says what the test wants; counts its starts."""
    starts = tmp_path / "starts"
    program = tmp_path / "blender"
    state = SimpleNamespace(starts=lambda: len(starts.read_text()) if starts.exists() else 0)

    def answers(line: str) -> None:
        program.write_text(f"#!/bin/sh\nprintf x >> '{starts}'\necho '{line}'\n")
        program.chmod(0o755)
        cycles_check._known.clear()

    app = SimpleNamespace(binary_path=str(program), version_string="5.2.2 LTS", timers=bpy.app.timers)
    monkeypatch.setattr(cycles_check, "bpy", SimpleNamespace(app=app, context=bpy.context))
    monkeypatch.setattr(cycles_check, "own_folder", lambda: tmp_path / "own")
    state.answers = answers
    answers(cycles_check.EMPTY)
    bpy.context.scene.render.engine = "CYCLES"
    yield state
    cycles_check.unregister()
    cycles_check._known.clear()


def panel() -> str:
    return " ".join(shown(render_panel.PRIMDIFFUSION_PT_render, bpy.context))


def until_checked() -> None:
    end = time.monotonic() + 30
    while cycles_check._follow() is not None:
        assert time.monotonic() < end
        time.sleep(0.02)


def test_the_panel_says_it_and_offers_the_engine_after_one_check(debian):
    assert FAULT not in panel()  # nothing is waited for
    until_checked()
    assert FAULT in panel()
    assert "primdiffusion.set_up_engine" in panel()
    cycles_check._known.clear()  # another start of the same Blender
    assert FAULT in panel()
    assert debian.starts() == 1


def test_the_command_line_waits_for_it(debian):
    assert cycles_check.check()
    assert cycles_check.check()
    assert debian.starts() == 1


def test_a_check_that_fails_claims_nothing_and_is_repeated_in_the_next_session(debian):
    debian.answers("no Cycles here")
    assert not cycles_check.check()
    assert not cycles_check.check()
    cycles_check._known.clear()
    assert not cycles_check.check()
    assert debian.starts() == 2


def test_without_cycles_nothing_is_checked(debian):
    bpy.context.scene.render.engine = "PRIMDIFFUSION"
    panel()
    assert cycles_check._running is None


def test_disabling_the_extension_ends_a_check(debian):
    panel()
    cycles_check.unregister()
    assert cycles_check._running is None


def test_this_blenders_cycles_draws_volumes():
    command = [sys.executable, "-P", str(cycles_check.PROGRAM)]  # -P: scene/cycles.py would hide Blender's own
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert cycles_check.DRAWN in done.stdout, done.stdout + done.stderr
