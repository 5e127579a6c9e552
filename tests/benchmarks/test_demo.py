"""The stages of `make demo`."""

from __future__ import annotations

import sys

import demo
from support.errors import refused


def test_a_long_stage_shows_how_far_it_is(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(demo, "PRINT_S", 0.1)
    program = "import time; print('Sample 1/4', flush=True); time.sleep(1.5)"
    assert demo.run_stage("Cycles", [sys.executable, "-c", program], tmp_path / "0.log").took.seconds > 1
    assert " s  Sample 1/4" in capsys.readouterr().out


def test_a_stage_that_fails_shows_the_end_of_its_output(tmp_path):
    with refused(demo.StageFailed, "exit code 3"):
        demo.run_stage("build", [sys.executable, "-c", "print('no room'); raise SystemExit(3)"], tmp_path / "0.log")
