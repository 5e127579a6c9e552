"""A Blender without numpy, as Debian may package it: the extension registers a panel that says what to install."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from blender_primdiffusion.console import UNUSABLE

pytestmark = pytest.mark.any_blender

ROOT = Path(__file__).parents[2]
CHILD = """
import json, sys
import bpy, numpy  # numpy first, or it could not be hidden
for name in [name for name in sys.modules if name.partition(".")[0] in ("numpy", "openvdb")] + ["openvdb"]:
    sys.modules[name] = None  # importing it fails
before = set(dir(bpy.types))
import blender_primdiffusion
blender_primdiffusion.register()
from blender_primdiffusion import without_numpy

class Layout:
    lines = []
    def column(self, align):
        return self
    def label(self, *, text, icon, translate):
        self.lines.append(text)

without_numpy._draw(Layout(), 34)
report = {
    "types": sorted(set(dir(bpy.types)) - before),
    "panel": Layout.lines,
    "code": without_numpy.execute(["generate"]),
    "modules": [name for name in sys.modules if name.startswith("blender_primdiffusion")],
}
blender_primdiffusion.unregister()
report["left"] = sorted(set(dir(bpy.types)) - before)
blender_primdiffusion.register()
print("REPORT", json.dumps(report))
"""


@pytest.fixture(scope="module")
def debian() -> tuple[dict, str]:
    """What a Blender without both packages registers, and what it prints as errors."""
    done = subprocess.run([sys.executable, "-c", CHILD], cwd=ROOT, capture_output=True, text=True, check=False)
    line = next((line for line in done.stdout.splitlines() if line.startswith("REPORT ")), None)
    assert line is not None, done.stdout + done.stderr
    return json.loads(line.removeprefix("REPORT ")), done.stderr


def test_one_panel_is_registered_and_leaves_no_trace(debian):
    report, _ = debian
    assert report["types"] == ["PRIMDIFFUSION_PT_without_numpy"]
    assert report["left"] == []
    assert not [name for name in report["modules"] if ".ui" in name or ".engine" in name]


def test_panel_and_console_name_the_packages_and_debians(debian):
    report, said = debian
    for text in (" ".join(report["panel"]), said):
        assert "lacks numpy and openvdb" in text
        assert "sudo apt install python3-numpy python3-openvdb" in text
    assert max(map(len, report["panel"])) <= 34


def test_the_command_line_is_refused_with_the_same_words(debian):
    report, said = debian
    assert report["code"] == UNUSABLE
    assert "primdiffusion: The Python of this Blender lacks numpy" in said
