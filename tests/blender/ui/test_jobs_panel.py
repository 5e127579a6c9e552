"""The panel Jobs, and what cancel says."""

import bpy
import pytest
from jobs_driven import drive
from support.errors import refused

from blender_primdiffusion.jobs.generate import GenerateJob
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.ui import jobs_panel

pytestmark = pytest.mark.any_blender
ops = bpy.ops.primdiffusion


def test_the_panel_jobs_is_shown_only_while_there_are_any(addon):
    shows = jobs_panel.PRIMDIFFUSION_PT_jobs.poll
    assert not shows(addon)
    queue.add(addon, GenerateJob(11, {"steps": 1}))
    assert shows(addon)
    drive()
    assert not shows(addon)


def test_cancel_says_what_is_not_running(addon):
    with refused(RuntimeError, "running"):
        ops.cancel()
    queue.add(addon, GenerateJob(11, {"steps": 1}))
    for what, sentence in (("CAPTURES", "no captures are being rendered"), ("SET_UP", "[Nn]othing is being set up")):
        with pytest.raises(RuntimeError, match=sentence):
            ops.cancel(what=what)
    drive()
