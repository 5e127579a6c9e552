"""The extension and its viewer in one Blender: the second is rejected whole, and Blender ends without an error."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import build_addon

pytestmark = pytest.mark.any_blender
PROGRAM = Path(__file__).parent / "installed_both.py"


@pytest.fixture(scope="module")
def archives(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("dist")
    return [build_addon.build(folder), build_addon.build(folder, viewer=True)]


@pytest.mark.parametrize("order", [1, -1], ids=["viewer second", "viewer first"])
def test_the_second_build_is_rejected_in_a_sentence_and_registers_nothing(archives, order, tmp_path):
    (tmp_path / "user").mkdir()
    environment = {name: text for name, text in os.environ.items() if not name.startswith(("PYTHON", "PRIMDIFFUSION"))}
    environment["BLENDER_USER_RESOURCES"] = str(tmp_path / "user")
    command = [sys.executable, str(PROGRAM), *map(str, archives[::order])]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=500, cwd=tmp_path)
    reports = [line for line in done.stdout.splitlines() if line.startswith("REPORT ")]
    assert reports, done.stdout[-3000:] + done.stderr[-3000:]
    report = json.loads(reports[0].removeprefix("REPORT "))
    first, second = report["first"], report["second"]
    assert report["message"].startswith(f"Error: {first} is enabled")
    assert "\n" not in report["message"].strip()
    assert report["beside"] == [[first], [first], False]
    assert report["after"] == [True, [second], [second]]
    at_exit = done.stdout.partition(reports[0])[2] + done.stderr.partition("same operators")[2]
    assert done.returncode == 0
    assert "Traceback" not in at_exit, at_exit
