"""The engine as a user gets it: in the zip, installed, with the backend that is bundled in it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from engine_stage import PYTHON, pixels

import build_addon


@pytest.mark.timeout(300)
def test_the_installed_extension_renders_and_blender_exits(tmp_path):
    archive, picture = build_addon.build(tmp_path), tmp_path / "picture.png"
    script = Path(__file__).parents[1] / "engine_installed.py"
    command = [sys.executable, str(script), str(archive), PYTHON, str(picture)]
    (tmp_path / "user").mkdir()
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "user")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=280, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    alpha = pixels(picture)[..., 3]
    assert alpha[16, 16] == 1.0
    assert alpha[0, 0] == 0.0
