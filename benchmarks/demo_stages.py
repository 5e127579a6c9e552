"""The stages of the demo that run in processes of their own.

`person` installs the extension in Blender, presses the button, walks, measures the volumes' motion and saves; it
generates through the extension's own operator and the real child process. `cycles` opens the saved file, merges the
human and renders one frame. `march` draws the generated human: rest, walking, side view, depth, primitives as boxes.
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
import torch
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.drawing.draw import Scene, ViewSettings, draw
from primdiffusion.human import framing, place
from primdiffusion.human_file import load_human
from primdiffusion.primitives.anchors import default_anchors
from primdiffusion.render.image import depth_to_png, rgba_to_png
from primdiffusion.render.march import march

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from walk import walk_and_wave

ROOT = Path(__file__).resolve().parents[1]

MODULE = "bl_ext.user_default.primdiffusion"
BACKGROUND = (0.72, 0.72, 0.72)


def person(arguments: argparse.Namespace) -> dict[str, float]:
    """Install, generate, keyframe, measure and save; returns the figures."""
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    bpy.ops.extensions.package_install_files(
        filepath=str(arguments.zip), repo="user_default", enable_on_install=True, overwrite=True
    )
    bpy.context.preferences.addons[MODULE].preferences.backend_python = sys.executable
    bpy.ops.wm.save_as_mainfile(filepath=str(arguments.blend))

    start = time.perf_counter()
    bpy.context.scene.primdiffusion.steps = arguments.steps
    bpy.ops.primdiffusion.generate(seed=arguments.seed)
    pressed = time.perf_counter() - start

    scene_human = import_module(f"{MODULE}.scene.human")
    armature = scene_human.humans(bpy.context.scene)[0]
    spent = import_module(f"{MODULE}.jobs.queue").queue.last.seconds
    rotations = walk_and_wave(arguments.frames)
    numbers = np.arange(1, arguments.frames + 1)
    start = time.perf_counter()
    import_module(f"{MODULE}.scene.armature").keyframe_poses(
        armature, numbers, rotations, np.zeros((arguments.frames, 3)), "Walk"
    )
    keyframed = time.perf_counter() - start
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, arguments.frames

    shutil.copyfile(import_module(f"{MODULE}.scene.payload").session_file(armature), arguments.human)
    checked = [1, 1 + arguments.frames // 3, arguments.shown + 1, arguments.frames]
    error = max(lbs_error_mm(armature, arguments.human, rotations[number - 1], number) for number in checked)
    bpy.context.scene.frame_set(arguments.shown + 1)
    bpy.ops.wm.save_as_mainfile(filepath=str(arguments.blend))
    return {
        "seconds_pressed_to_standing": pressed,
        "seconds_generate": spent["work"],
        "seconds_build_scene": spent["finish"],
        "seconds_keyframes": keyframed,
        "lbs_error_mm_max": error,
    }


def lbs_error_mm(armature: bpy.types.Object, human_file: Path, rotation: np.ndarray, number: int) -> float:
    """Largest distance in mm between a vertex that Blender has skinned and the same one skinned by the backend."""
    human = load_human(human_file)
    shaped = default_body().to(dtype=torch.float64).shape(human.betas.double())
    posed = shaped.pose(BodyPose(torch.from_numpy(rotation), torch.zeros(3, dtype=torch.float64))).vertices.numpy()
    upright = np.stack([posed[:, 0], -posed[:, 2], posed[:, 1]], -1)  # y up to z up
    upright += import_module(f"{MODULE}.scene.armature").model_origin(armature.data)
    body = import_module(f"{MODULE}.scene.human").body_of(armature)
    body.hide_viewport = False  # what is hidden is not evaluated
    bpy.context.scene.frame_set(number)
    evaluated = body.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    found = np.empty((len(evaluated.vertices), 3))
    evaluated.vertices.foreach_get("co", found.ravel())
    body.hide_viewport = True
    return float(np.linalg.norm(found - upright, axis=-1).max() * 1e3)


def cycles(arguments: argparse.Namespace) -> dict[str, float]:
    """Open the saved file, merge the human as it stands, and render the current frame in Cycles."""
    bpy.ops.wm.open_mainfile(filepath=str(arguments.blend))
    sys.path.insert(0, str(ROOT))
    from cycles_preview import setup_cycles_preview

    import blender_primdiffusion
    from blender_primdiffusion.scene.human import humans

    blender_primdiffusion.register()
    scene = bpy.context.scene
    (bpy.context.view_layer.objects.active,) = humans(scene)
    start = time.perf_counter()
    scene.primdiffusion_merging.voxel = arguments.voxel
    bpy.ops.primdiffusion.merge()
    merged = time.perf_counter() - start
    yaw = math.radians(arguments.yaw)
    setup_cycles_preview(scene, size=arguments.size, samples=arguments.samples, yaw=yaw, world=0.48)
    start = time.perf_counter()
    bpy.app.handlers.render_stats.append(lambda stats, _: print(stats, flush=True))  # the demo shows the last line
    bpy.ops.render.render()
    bpy.data.images["Render Result"].save_render(str(arguments.out))
    return {"seconds_cycles": time.perf_counter() - start, "seconds_merge": merged}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    stages = parser.add_subparsers(required=True)
    making = stages.add_parser("person")
    making.set_defaults(stage=person)
    for name in ("zip", "blend", "human", "json"):
        making.add_argument(f"--{name}", type=Path, required=True)
    making.add_argument("--seed", type=int, required=True)
    making.add_argument("--steps", type=int, default=30)
    making.add_argument("--frames", type=int, default=48)
    making.add_argument("--shown", type=int, default=31, help="frame of the walk to show, counted from 0")
    drawing = stages.add_parser("cycles")
    drawing.set_defaults(stage=cycles)
    for name in ("blend", "out", "json"):
        drawing.add_argument(f"--{name}", type=Path, required=True)
    drawing.add_argument("--size", type=int, default=384)
    drawing.add_argument("--samples", type=int, default=16)
    drawing.add_argument("--voxel", type=float, default=0.004, help="metres")
    drawing.add_argument("--yaw", type=float, default=29, help="degrees around the person, 0 is the front")
    marching = stages.add_parser("march")
    marching.set_defaults(stage=march_pictures)
    for name in ("human", "out", "json"):
        marching.add_argument(f"--{name}", type=Path, required=True)
    marching.add_argument("--frames", type=int, required=True)
    marching.add_argument("--frame", type=int, required=True, help="frame of the walk, counted from 0")
    arguments = parser.parse_args()
    arguments.json.write_text(json.dumps(arguments.stage(arguments)), encoding="utf-8")


def share_on_body(position: torch.Tensor) -> float:
    """Share of the grid's cells with a distinct point on the body: on a face, 1 mm or more from all others."""
    distance = torch.cdist(position.double(), position.double())
    distance.fill_diagonal_(torch.inf)
    body, anchors = default_body(), default_anchors()
    on_a_face = (anchors.face >= 0) & (anchors.face < body.faces.shape[0]) & (anchors.barycentric >= -1e-6).all(-1)
    return float((on_a_face & (distance.amin(-1) >= 1e-3)).float().mean())


def march_pictures(arguments: argparse.Namespace) -> dict[str, float]:
    """Draw the human at rest and in a frame of the walk."""
    human = load_human(arguments.human)
    rotation = torch.from_numpy(walk_and_wave(arguments.frames)[arguments.frame]).float()
    rest = place(human, None)
    walking = place(human, BodyPose(rotation, torch.zeros(3)))
    front = framing(rest)
    march(rest, front)  # compiles, or loads the compiled code
    start = time.perf_counter()
    rendering = march(rest, front)
    seconds = time.perf_counter() - start

    rendering.save(arguments.out / "march_rest.png", BACKGROUND)
    depth_to_png(arguments.out / "march_depth.png", rendering.depth, rendering.alpha)
    march(walking, framing(walking)).save(arguments.out / "march_posed.png", BACKGROUND)
    march(walking, framing(walking, 70)).save(arguments.out / "march_side.png", BACKGROUND)
    boxes = draw(Scene(rest, chart=default_anchors().chart), front, ViewSettings("boxes"))
    rgba_to_png(arguments.out / "march_boxes.png", torch.from_numpy(boxes.rgba), BACKGROUND)
    return {"seconds_march_512": seconds, "grid_share_on_body": share_on_body(rest.position)}


if __name__ == "__main__":
    main()
