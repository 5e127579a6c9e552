"""Run by test_viewer in a Blender of its own: install the viewer, use a human of its gallery, report as JSON.

python installed_viewer.py ZIP FOLDER [PROGRAM]

Without PROGRAM, the backend's command line as pip installed it, there is no backend; with it, a human is generated
with the program on the PATH, and another with the program named in the preferences.
"""

import json
import os
import sys
import time
from importlib import import_module
from pathlib import Path

import bpy
import numpy as np

archive, folder = sys.argv[1], Path(sys.argv[2])
program = Path(sys.argv[3]) if len(sys.argv) > 3 else None
sys.modules["primdiffusion"] = None  # as in a Blender whose Python has no backend
os.environ["PATH"] = ""
bpy.ops.extensions.package_install_files(filepath=archive, repo="user_default", enable_on_install=True)
(module,) = [name for name in bpy.context.preferences.addons.keys() if name.endswith("_viewer")]  # noqa: SIM118
human, picture, boxes = (
    import_module(f"{module}.{name}") for name in ("scene.human", "engine.picture", "engine.boxes")
)
press = bpy.ops.primdiffusion
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"))


def centres() -> np.ndarray:
    """Where the engine draws the boxes of the first human."""
    bpy.context.view_layer.update()
    person = human.humans(bpy.context.scene)[0]
    armature = person
    return boxes.boxes_of(picture.pose_of(armature, np.array(armature.matrix_world))).position


report = {"module": module}
started = time.perf_counter()
report["added"] = sorted(press.import_human(filepath=str(Path(human.__file__).parents[1] / "gallery" / "Ada.human")))
report["seconds"] = time.perf_counter() - started
person = human.humans(bpy.context.scene)[0]
armature = person
report["name"], report["bones"] = person.name, len(armature.data.bones)
rest = centres()
bone = armature.pose.bones["left_shoulder"]
bone.rotation_mode = "XYZ"
bone.rotation_euler = (0, 0, 1)
bone.keyframe_insert("rotation_euler", frame=1)
posed = centres()

armature.primdiffusion_human.betas = [2.0] + [0.0] * 9
reshaped = centres()
report["moved"] = [float(np.abs(after - before).max()) for before, after in ((rest, posed), (posed, reshaped))]
file = folder / "again.human"
report["exported"] = sorted(press.export(filepath=str(file)))
report["bytes"] = file.stat().st_size
report["imported"] = sorted(press.import_human(filepath=str(file)))
report["humans"] = len(human.humans(bpy.context.scene))
press.set_representation(representation="VOLUMES")
press.volumes_in_viewport()
report["volumes"] = len(list(Path(bpy.app.tempdir).rglob("*.vdb")))
try:
    press.generate(seed=7)
except RuntimeError as error:
    report["generate"] = str(error)
panels = ("generate", "human", "render")
polls = {name: getattr(getattr(bpy.types, f"PRIMDIFFUSION_PT_{name}"), "poll", None) for name in panels}
report["panels"] = [name for name, poll in polls.items() if poll is None or poll(bpy.context)]
report["rejected"] = []
bpy.context.scene.primdiffusion_export.format = "GLB"
for operator, words in (
    (press.export, {"filepath": str(folder / "mesh.glb")}),
    (press.set_up_engine, {"engine": "PRIMDIFFUSION"}),
):
    try:
        operator(**words)
    except RuntimeError as error:
        report["rejected"].append(str(error))
if program is not None:
    os.environ["PATH"] = str(program.parent)
    report["generated"] = [sorted(press.generate(seed=7))]
    os.environ["PATH"] = ""
    bpy.context.preferences.addons[module].preferences.backend_python = str(program)
    report["generated"].append(sorted(press.generate(seed=8)))
    made = human.humans(bpy.context.scene)[2:]
    report["boxes"] = [sum(obj.type == "VOLUME" for obj in human.parts_of(one)) for one in made]
    report["provenance"] = [json.loads(one[human.MARK])["seed"] for one in made]
    report["standing"] = [one.name in bpy.context.view_layer.objects for one in made]
bpy.ops.preferences.addon_disable(module=module)
print("REPORT " + json.dumps(report), flush=True)
