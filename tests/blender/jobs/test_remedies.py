"""The button that an error offers."""

from __future__ import annotations

import errno

import bpy
import pytest
from jobs_driven import shown
from support.fake_child import DIES, NO_MEMORY

from blender_primdiffusion.backend.requests import RequestError
from blender_primdiffusion.jobs import remedies
from blender_primdiffusion.ui.generate_panel import PRIMDIFFUSION_PT_generate

pytestmark = pytest.mark.any_blender
ops = bpy.ops.primdiffusion


def test_each_error_has_a_button_where_there_is_something_to_do(addon):
    for kind in ("died", "hung", "busy", "timeout"):
        assert remedies.remedy_for(RequestError("", "", kind)).operator == "primdiffusion.try_again"
    assert remedies.remedy_for(RequestError("", "", "out_of_memory")).operator == "primdiffusion.release_memory"
    assert remedies.remedy_for(RequestError("", "", "unwritable")).operator == "wm.save_as_mainfile"
    no_checkpoint = RequestError("there is no checkpoint at 'x.safetensors'", "", "missing_file")
    assert remedies.remedy_for(no_checkpoint).operator == "preferences.addon_show"
    assert remedies.remedy_for(RequestError("there is no folder of captures 'x'", "", "missing_file")) is None
    assert remedies.remedy_for(RequestError("", "", "bad_input")) is None
    environment = remedies.remedy_for(RequestError("", "", "environment"))
    assert environment is None or environment.operator == "primdiffusion.set_up_backend"


def test_the_panel_shows_the_error_its_button_and_the_diagnostics(addon):
    for seed, button in ((DIES, "try_again"), (NO_MEMORY, "release_memory")):
        with pytest.raises(RuntimeError):
            ops.generate(seed=seed)
        texts = shown(PRIMDIFFUSION_PT_generate, addon)
        assert f"primdiffusion.{button}" in texts
        assert "primdiffusion.copy_diagnostics" in texts


def test_a_full_disk_is_a_kind_of_its_own(addon):
    full = OSError(errno.ENOSPC, "No space left on device", "x.vdb")
    wrapped = RuntimeError("the volumes cannot be written")
    wrapped.__cause__ = full
    for error in (full, wrapped):
        assert remedies.error_in_the_scene(error).kind == "unwritable"
    assert remedies.error_in_the_scene(ValueError("no")).kind == "scene"
