"""The demo in Blender: install the extension, press the button, walk, save, merge the human and render it in Cycles.

It generates through the extension's own operator and the real child process, which merges, too: that starts once.
Blender's settings are in a temporary folder, so those of an installed Blender do not change.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import time
from importlib import import_module
from pathlib import Path

import blender_isolated  # noqa: F401  before bpy
import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from cycles_preview import setup_cycles_preview
from walk import walk_and_wave

MODULE = "bl_ext.user_default.primdiffusion"


def person(arguments: argparse.Namespace) -> dict[str, float]:
    """Install, generate, keyframe and save; returns the figures."""
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    bpy.ops.extensions.package_install_files(
        filepath=str(arguments.zip), repo="user_default", enable_on_install=True, overwrite=True
    )
    bpy.context.preferences.addons[MODULE].preferences.backend_python = sys.executable
    bpy.context.preferences.filepaths.save_version = 0  # leaves no .blend1
    bpy.ops.object.light_add(type="SUN", location=(2, -2, 4), rotation=(0.7, 0, 0.5))
    bpy.ops.wm.save_as_mainfile(filepath=str(arguments.blend))

    start = time.perf_counter()
    bpy.context.scene.primdiffusion.steps = arguments.steps
    bpy.ops.primdiffusion.generate(seed=arguments.seed)
    pressed = time.perf_counter() - start

    scene_human = import_module(f"{MODULE}.scene.human")
    armature = scene_human.humans(bpy.context.scene)[0]
    rotations = walk_and_wave(arguments.frames)
    start = time.perf_counter()
    import_module(f"{MODULE}.scene.armature").keyframe_poses(
        armature, np.arange(1, arguments.frames + 1), rotations, np.zeros((arguments.frames, 3)), "Walk"
    )
    keyframed = time.perf_counter() - start
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, arguments.frames

    shutil.copyfile(scene_human.session_file(armature), arguments.human)
    numbers = [1, 1 + arguments.frames // 3, arguments.shown + 1, arguments.frames]
    np.savez(arguments.skinned, frames=numbers, vertices=np.stack([skinned(armature, number) for number in numbers]))
    scene, yaw = bpy.context.scene, math.radians(arguments.yaw)
    scene.frame_set(arguments.shown + 1)
    setup_cycles_preview(scene, size=arguments.size, samples=arguments.samples, yaw=yaw, world=0.48)
    bpy.ops.primdiffusion.set_up_engine(engine="PRIMDIFFUSION")
    bpy.ops.wm.save_as_mainfile(filepath=str(arguments.blend))
    return {
        "seconds_pressed_to_standing": pressed,
        "seconds_keyframes": keyframed,
    }


def skinned(armature: bpy.types.Object, number: int) -> np.ndarray:
    """Vertices of the body [V, 3] in a frame as Blender has skinned them, metres, z up, from the model's origin."""
    body = import_module(f"{MODULE}.scene.human").body_of(armature)
    body.hide_viewport = False  # what is hidden is not evaluated
    bpy.context.scene.frame_set(number)
    evaluated = body.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    found = np.empty((len(evaluated.vertices), 3))
    evaluated.vertices.foreach_get("co", found.ravel())
    body.hide_viewport = True
    return found - import_module(f"{MODULE}.scene.armature").model_origin(armature.data)


def cycles(arguments: argparse.Namespace) -> dict[str, float]:
    """Merge the human as it stands, and render the current frame in Cycles."""
    scene = bpy.context.scene
    (bpy.context.view_layer.objects.active,) = import_module(f"{MODULE}.scene.human").humans(scene)
    start = time.perf_counter()
    bpy.ops.primdiffusion.merge()
    merged = time.perf_counter() - start
    scene.render.engine = "CYCLES"
    start = time.perf_counter()
    bpy.app.handlers.render_stats.append(lambda stats, _: print(stats, flush=True))  # the demo shows the last line
    bpy.ops.render.render()
    bpy.data.images["Render Result"].save_render(str(arguments.cycles))
    return {"seconds_cycles": time.perf_counter() - start, "seconds_merge": merged}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("zip", "blend", "human", "skinned", "json"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--frames", type=int, default=48)
    parser.add_argument("--shown", type=int, default=31, help="frame of the walk to show, counted from 0")
    parser.add_argument("--cycles", type=Path, help="picture to render; without it, nothing is rendered")
    parser.add_argument("--size", type=int, default=384)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--yaw", type=float, default=29, help="degrees around the person, 0 is the front")
    arguments = parser.parse_args()
    figures = person(arguments)
    if arguments.cycles is not None:
        figures |= cycles(arguments)
    arguments.json.write_text(json.dumps(figures), encoding="utf-8")


if __name__ == "__main__":
    main()
