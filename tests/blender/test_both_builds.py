"""The extension and its viewer in one Blender: the second is rejected whole, and Blender ends without an error."""

from pathlib import Path

import pytest
from own_blender import report_of

import build_addon

pytestmark = pytest.mark.any_blender


@pytest.fixture(scope="module")
def archives(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("dist")
    return [build_addon.build(folder), build_addon.build(folder, viewer=True)]


@pytest.mark.parametrize("order", [1, -1], ids=["viewer second", "viewer first"])
def test_the_second_build_is_rejected_in_a_sentence_and_registers_nothing(archives, order, tmp_path):
    report, done = report_of("installed_both.py", *archives[::order], folder=tmp_path, bare=True)
    first, second = report["first"], report["second"]
    assert report["message"].startswith(f"Error: {first} is enabled")
    assert "\n" not in report["message"].strip()
    assert report["beside"] == [[first], [first], False]
    assert report["after"] == [True, [second], [second]]
    at_exit = done.stdout.partition("REPORT ")[2] + done.stderr.partition("same operators")[2]
    assert done.returncode == 0
    assert "Traceback" not in at_exit, at_exit
