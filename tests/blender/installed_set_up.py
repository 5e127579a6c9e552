"""Run by test_setup_installed in a Blender of its own: install the zip, set up its backend, generate, repair, report.

python installed_set_up.py ZIP
"""

import json
import os
import sys
import time
from importlib import import_module
from pathlib import Path

import bpy

(archive,) = sys.argv[1:]
os.environ.pop("PRIMDIFFUSION_PYTHON", None)
bpy.ops.extensions.package_install_files(filepath=archive, repo="user_default", enable_on_install=True)
(module,) = [name for name in bpy.context.preferences.addons.keys() if name.endswith(".primdiffusion")]  # noqa: SIM118
setup = import_module(f"{module}.ui.setup")
preferences = import_module(f"{module}.ui.preferences")
state_of = import_module(f"{module}.backend.environment").state_of
places = import_module(f"{module}.places")
preferences.own_python_has_backend = lambda **_: False  # as in a Blender that is no module of a Python with torch
report = {
    "blender": bpy.app.version_string,
    "root": str(places.set_up_folder().root),
    "before": preferences.known().state,
}
bpy.context.preferences.system.use_online_access = True
report["cost"] = setup.cost(setup.chosen()[1])
started = time.perf_counter()
report["outcome"] = sorted(bpy.ops.primdiffusion.set_up_backend())
report["seconds"] = round(time.perf_counter() - started, 1)
report["after"] = preferences.known().state
report["about"] = state_of(places.set_up_folder())[1]
bpy.ops.wm.save_as_mainfile(filepath=str(Path(os.environ["BLENDER_USER_RESOURCES"]) / "shot.blend"))
started = time.perf_counter()
bpy.context.scene.primdiffusion.steps = 3
report["generated"] = sorted(bpy.ops.primdiffusion.generate(seed=3))
report["seconds_generate"] = round(time.perf_counter() - started, 1)
report["bones"] = [len(obj.data.bones) for obj in bpy.data.objects if obj.type == "ARMATURE"]
started = time.perf_counter()
report["repaired"] = sorted(bpy.ops.primdiffusion.set_up_backend(repair=True))
report["seconds_repair"] = round(time.perf_counter() - started, 1)
report["at_last"] = preferences.known().state
bpy.ops.preferences.addon_disable(module=module)
print("REPORT " + json.dumps(report), flush=True)
