"""What a run of the tests leaves on the disk."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.any_blender
ROOT = Path(__file__).parents[2]


def test_a_run_that_passes_leaves_no_files(tmp_path):
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
    here = Path(__file__).parent
    chosen = [str(here / "scene/test_volumes.py"), "--confcutdir", str(here)]  # Blender 5.2's Python has no torch
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST_", "BLENDER_"))}
    environment["TMPDIR"] = str(tmp_path)
    done = subprocess.run(
        [*command, *chosen], env=environment, cwd=ROOT, capture_output=True, text=True, timeout=500, check=False
    )
    assert " passed" in done.stdout, done.stdout + done.stderr
    assert [path for path in tmp_path.rglob("*") if path.name != "pytest-current" and not path.is_dir()] == []
    assert not list(tmp_path.glob("*blender_*"))
