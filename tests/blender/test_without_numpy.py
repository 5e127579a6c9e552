"""A Blender without numpy, as Debian may package it: enabling the extension says what to install."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.any_blender

ROOT = Path(__file__).parents[2]
CHILD = """
import sys
import bpy, numpy  # numpy first, or it could not be hidden
for name in [name for name in sys.modules if name.partition(".")[0] == "numpy"]:
    sys.modules[name] = None  # importing it fails
before = set(dir(bpy.types))
import blender_primdiffusion
try:
    blender_primdiffusion.register()
except ImportError as error:
    print("REFUSED", error)
assert set(dir(bpy.types)) == before
"""


def test_enabling_it_names_the_package_and_debians_and_registers_nothing():
    done = subprocess.run([sys.executable, "-c", CHILD], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    said = next(line for line in done.stdout.splitlines() if line.startswith("REFUSED"))
    assert "lacks numpy" in said
    assert "sudo apt install python3-numpy python3-openvdb" in said
