"""What enabling the extension costs at each start of Blender."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
MOST_MODULES = 120
"""Of ours. Each costs about half a millisecond; what works, as against what is drawn, is imported when asked for."""
LATE = (
    "scene.build", "scene.edit", "scene.merged", "scene.shape", "scene.surface", "scene.volumes", "scene.human_npz",
    "scene.collect", "scene.human_file", "scene.proxy", "scene.reshape", "capture.settings", "formats.camera_rig",
    "motion.poses", "engine.viewport", "engine.studio", "jobs.generate", "jobs.edit", "jobs.assets", "jobs.export",
    "ui.motion_placing",
)  # fmt: skip
"""Modules of ours that registering must not import: they bring others along, or numpy."""
CHILD = """
import bpy, sys
for name in [name for name in sys.modules if name.partition(".")[0] == "numpy"]:
    sys.modules[name] = None  # Blender has not imported it when it enables extensions: so importing it fails here
import blender_primdiffusion
blender_primdiffusion.register()
print("HAS", *(name for name, module in sys.modules.items() if module is not None))
"""


def registered_modules() -> set[str]:
    """Names of the modules that a Blender has imported once the extension is registered."""
    done = subprocess.run([sys.executable, "-c", CHILD], cwd=ROOT, capture_output=True, text=True, check=False)
    assert "HAS" in done.stdout, done.stderr
    line = next(line for line in done.stdout.splitlines() if line.startswith("HAS"))
    return set(line.split()[1:])


def test_registering_imports_few_modules_and_no_backend():
    modules = registered_modules()
    ours = {name.removeprefix("blender_primdiffusion.") for name in modules if name.startswith("blender_primdiffusion")}
    assert len(ours) <= MOST_MODULES
    assert not ours & set(LATE)
    assert not modules & {"numpy", "torch", "openvdb", "scipy", "primdiffusion"}
