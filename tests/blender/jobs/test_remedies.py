"""The button that an error offers."""

from __future__ import annotations

import errno
from pathlib import Path

import bpy
import pytest
from jobs_driven import shown
from support.fake_child import FAILS, NO_MEMORY

from blender_primdiffusion.backend.requests import RequestError
from blender_primdiffusion.jobs import remedies
from blender_primdiffusion.ui.generate_panel import PRIMDIFFUSION_PT_generate

pytestmark = pytest.mark.any_blender
ops = bpy.ops.primdiffusion


def test_each_error_has_a_button_where_there_is_something_to_do(addon):
    for kind in ("died", "hung", "busy", "timeout", "out_of_memory"):
        assert remedies.remedy_for(RequestError("", "", kind)) is None
    assert remedies.remedy_for(RequestError("", "", "unwritable")).operator == "wm.save_as_mainfile"
    no_checkpoint = RequestError("there is no checkpoint at 'x.safetensors'", "", "missing_file")
    assert remedies.remedy_for(no_checkpoint).operator == "preferences.addon_show"
    assert remedies.remedy_for(RequestError("there is no folder of captures 'x'", "", "missing_file")) is None
    assert remedies.remedy_for(RequestError("", "", "bad_input")) is None
    assert remedies.remedy_for(RequestError("", "", "environment")).operator == "primdiffusion.set_up_backend"


def test_the_panel_shows_the_error_its_button_and_the_log(addon):
    with pytest.raises(RuntimeError):
        ops.generate(seed=NO_MEMORY)
    texts = shown(PRIMDIFFUSION_PT_generate, addon)
    assert "wm.path_open" in texts


def test_the_log_holds_versions_and_the_error(addon):
    with pytest.raises(RuntimeError):
        ops.generate(seed=FAILS)
    text = remedies.error_log().read_text(encoding="utf-8")
    for part in (bpy.app.version_string, "0-fake", "fake device", "seed 2", "CheckpointError", "checkpoint is damaged"):
        assert part in text
    assert str(Path.home()) not in text


def test_a_full_disk_is_a_kind_of_its_own(addon):
    full = OSError(errno.ENOSPC, "No space left on device", "x.vdb")
    wrapped = RuntimeError("the volumes cannot be written")
    wrapped.__cause__ = full
    for error in (full, wrapped):
        assert remedies.error_in_the_scene(error).kind == "unwritable"
    assert remedies.error_in_the_scene(ValueError("no")).kind == "scene"
