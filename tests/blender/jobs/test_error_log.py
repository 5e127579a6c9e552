"""How errors are shown and logged."""

from __future__ import annotations

from pathlib import Path

import bpy
import pytest
from jobs_driven import shown
from support.fake_child import FAILS, NO_MEMORY

from blender_primdiffusion.jobs import error_log
from blender_primdiffusion.ui.generate_panel import PRIMDIFFUSION_PT_generate

pytestmark = pytest.mark.any_blender
ops = bpy.ops.primdiffusion


def test_the_panel_shows_the_error_its_button_and_the_log(addon):
    with pytest.raises(RuntimeError):
        ops.generate(seed=NO_MEMORY)
    texts = shown(PRIMDIFFUSION_PT_generate, addon)
    assert "wm.path_open" in texts


def test_the_log_holds_versions_and_the_error(addon):
    with pytest.raises(RuntimeError):
        ops.generate(seed=FAILS)
    text = error_log.error_log().read_text(encoding="utf-8")
    for part in (bpy.app.version_string, "0-fake", "fake device", "seed 2", "CheckpointError", "checkpoint is damaged"):
        assert part in text
    assert str(Path.home()) not in text
