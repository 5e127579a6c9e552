"""A Blender without numpy or OpenImageIO, as Debian may package it: enabling the extension says what to install."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.any_blender

ROOT = Path(__file__).parents[2]
CHILD = """
import sys
import bpy, numpy  # numpy first, or it could not be hidden
bpy.utils.expose_bundled_modules()
import OpenImageIO
lacking = sys.argv[1]
for name in [lacking, *(name for name in sys.modules if name.startswith(lacking + "."))]:
    sys.modules[name] = None  # importing it fails
before = set(dir(bpy.types))
import blender_primdiffusion
try:
    blender_primdiffusion.register()
except ImportError as error:
    print("REFUSED", error)
assert set(dir(bpy.types)) == before
"""


@pytest.mark.parametrize("lacking", ["numpy", "OpenImageIO"])
def test_enabling_it_names_the_package_and_debians_and_registers_nothing(lacking):
    done = subprocess.run([sys.executable, "-c", CHILD, lacking], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    said = next(line for line in done.stdout.splitlines() if line.startswith("REFUSED"))
    assert f"lacks {lacking}" in said
    assert "sudo apt install python3-numpy python3-openvdb python3-openimageio" in said
