"""Diagnostics for bug reports."""

from __future__ import annotations

from pathlib import Path

import bpy
import pytest
from jobs_driven import drive, shown
from support.errors import refused
from support.fake_child import FAILS

from blender_primdiffusion.jobs.generate import GenerateJob
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.ui import jobs_panel
from blender_primdiffusion.ui.advanced_panel import PRIMDIFFUSION_PT_advanced

pytestmark = pytest.mark.any_blender
ops = bpy.ops.primdiffusion


def test_diagnostics_hold_versions_and_the_error(addon):
    with pytest.raises(RuntimeError):
        ops.generate(seed=FAILS)
    text = jobs_panel.diagnostics()
    for part in (bpy.app.version_string, "0-fake", "fake device", "seed 2", "CheckpointError", "checkpoint is damaged"):
        assert part in text
    assert str(Path.home()) not in text
    assert ops.copy_diagnostics() == {"FINISHED"}
    assert bpy.data.texts[jobs_panel.TEXT].as_string().strip() == text.strip()
    ops.copy_diagnostics()
    assert len(bpy.data.texts) == 1


def test_the_panel_jobs_is_shown_only_while_there_are_any(addon):
    shows = jobs_panel.PRIMDIFFUSION_PT_jobs.poll
    assert not shows(addon)
    queue.add(addon, GenerateJob(11, {"steps": 1}))
    assert shows(addon)
    drive()
    assert queue.ended
    assert not shows(addon)
    assert {"primdiffusion.release_memory", "primdiffusion.copy_diagnostics"} <= set(
        shown(PRIMDIFFUSION_PT_advanced, addon, opened=True)
    )


def test_cancel_says_what_is_not_running(addon):
    with refused(RuntimeError, "Nothing"):
        ops.cancel()
    queue.add(addon, GenerateJob(11, {"steps": 1}))
    for what, sentence in (("CAPTURES", "no captures are being rendered"), ("SET_UP", "[Nn]othing is being set up")):
        with pytest.raises(RuntimeError, match=sentence):
            ops.cancel(what=what)
    drive()


def test_diagnostics_can_be_copied_before_anything_was_done(addon):
    queue.last = None
    assert "not started yet" in jobs_panel.diagnostics()
