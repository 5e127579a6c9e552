"""Run by test_addon_zip in a Blender of its own: install the zip, generate a human through the operator, render it with
the engine beside a cube, report as JSON.

python installed_generate.py ZIP CHECKPOINT_OR_EMPTY BLEND SEED STEPS PICTURE
"""

import json
import os
import sys
import time
from pathlib import Path

import bpy

archive, checkpoint, blend, seed, steps, picture = sys.argv[1:]
bpy.ops.extensions.package_install_files(filepath=archive, repo="user_default", enable_on_install=True)
(module,) = [name for name in bpy.context.preferences.addons.keys() if name.endswith(".primdiffusion")]  # noqa: SIM118
addon = bpy.context.preferences.addons[module].preferences
addon.backend_python = os.environ.get("PRIMDIFFUSION_PYTHON", sys.executable)  # another one, where this has no torch
addon.checkpoint = checkpoint
bpy.ops.wm.save_as_mainfile(filepath=blend)

started = time.perf_counter()
bpy.context.scene.primdiffusion.steps = int(steps)
outcome = bpy.ops.primdiffusion.generate(seed=int(seed))
seconds = time.perf_counter() - started
bpy.ops.wm.save_mainfile()
bpy.ops.wm.open_mainfile(filepath=blend)
armature = next(o for o in bpy.context.scene.objects if o.type == "ARMATURE")

scene = bpy.context.scene
scene.render.engine = "PRIMDIFFUSION"
scene.render.resolution_x = scene.render.resolution_y = 32
scene.render.film_transparent = True
scene.render.filepath = picture
scene.render.image_settings.color_mode = "RGBA"
bpy.ops.mesh.primitive_cube_add(size=1.0, location=(1.5, 0.0, 1.0))
bpy.ops.object.camera_add(location=(0.0, -6.0, 1.0), rotation=(1.5708, 0.0, 0.0))
scene.camera = bpy.context.object
bpy.ops.render.render(write_still=True)

installed = Path(sys.modules[module].__file__).parent
report = {
    "outcome": sorted(outcome),
    "module": module,
    "volumes": sum("primdiffusion_volumes" in o for o in bpy.context.scene.objects),
    "splats": sum(len(o.data.points) for o in bpy.context.scene.objects if o.type == "POINTCLOUD"),
    "bones": len(armature.data.bones),
    "files": len(list(Path(bpy.app.tempdir).rglob("*.vdb"))),
    "kernels_in_the_addon": [p.name for p in installed.rglob("*") if p.suffix in (".nbi", ".nbc")],
    "backend_in_zip": (installed / "bundled" / "primdiffusion" / "human.py").is_file(),
    "seconds": seconds,
}
print("REPORT " + json.dumps(report), flush=True)
