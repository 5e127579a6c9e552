"""Compares a person in Cycles as 1024 volumes, as one merged volume, and in the engine.

`python benchmarks/merged.py --json merged.json --pictures DIR` poses the default checkpoint's person 7 and renders
512 x 512 pixels with one sample. merged_speedup is the time of the Cycles picture of 1024 volumes divided by that of
the merged one. PSNRs are of 8-bit pictures over grey. Frame times are the fastest `frame_set` with 1024 volumes;
surface_error is against the backend's own frames on the posed surface. `--no-volumes` skips the slow render.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path

import blender_isolated  # noqa: F401  before bpy
import bpy
import numpy as np
import psutil
import torch
from mathutils import Matrix
from primdiffusion.body.model import BodyPose
from primdiffusion.commands import export as commands
from primdiffusion.commands.session import Session
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.formats.requests import DENSITY_GAIN, MergeRequest, PosedPerson
from primdiffusion.human import body_of, framing, generate, place_skinned, pose_body
from primdiffusion.human_file import load_human, save_human
from primdiffusion.primitives.anchors import attach
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.march import march
from record import command_line, report

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from cycles_preview import setup_cycles_preview

import blender_primdiffusion
from blender_primdiffusion.scene import merged as merging
from blender_primdiffusion.scene.armature import keyframe_poses, model_origin, pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.representation import set_representation, show_in_viewport
from blender_primdiffusion.scene.volume_nodes import GAIN_NODE, MATERIAL_NAME, files_of, write_volumes

SEED, STEPS, SIZE, GREY = 7, 30, 512, 0.48
FRAMES = 10
FAINT = 1e-4
"""Factor on density with which no ray of a human saturates."""
MET = 1e-3
"""Rays with less opacity than this miss the human."""
GAIN_PIXELS, GAINS = 128, np.geomspace(0.1, 20, 2000).tolist()
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def strong_poses(count: int) -> np.ndarray:
    """Rotations [count, 24, 3, 3] with an angle of typically 25 degrees or more per joint."""
    turns = torch.randn(count, 72, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.45
    return BodyPose.from_axis_angle(turns).joint_rotation.numpy()


def step_pose() -> np.ndarray:
    """Rotations [24, 3, 3] of the pose in the pictures: a step, with bent arms."""
    turns = torch.zeros(24, 3, dtype=torch.float64)
    turns[1, 0], turns[2, 0], turns[5, 0] = -0.5, 0.35, 0.6
    turns[16, 2], turns[17, 2], turns[18, 1], turns[19, 1] = -0.9, 0.8, -0.9, 0.5
    return BodyPose.from_axis_angle(turns.flatten()).joint_rotation.numpy()


def frame_ms() -> float:
    """Milliseconds of the fastest frame_set over the keyed frames; the fastest, as other programs only add time."""
    times = []
    for number in [*range(1, FRAMES + 1)] * 3:
        began = time.perf_counter()
        bpy.context.scene.frame_set(number)
        times.append(time.perf_counter() - began)
    return 1e3 * min(times)


def surface_error(human, armature, rotations: np.ndarray) -> tuple[float, float]:
    """Largest distance (mm) and angle (degrees) between instances and the backend's frames, over all frames."""
    body, anchors = body_of(human)
    distance = angle = 0.0
    for number, rotation in enumerate(rotations, 1):
        bpy.context.scene.frame_set(number)
        pose = BodyPose(torch.from_numpy(rotation).float(), torch.zeros(3))
        frames = attach(anchors, pose_body(human.betas, pose).vertices, body.faces)
        graph = bpy.context.evaluated_depsgraph_get()
        matrices = np.array([np.array(i.matrix_world) for i in graph.object_instances if i.is_instance])
        matrices[:, :3, :3] /= np.linalg.norm(matrices[:, :3, :3], axis=1, keepdims=True)  # boxes stretch with the skin
        world = np.array(armature.matrix_world @ Matrix.Translation(model_origin(armature.data)))
        expected = frames.position.double().numpy() @ Z_UP.T @ world[:3, :3].T + world[:3, 3]
        distance = max(distance, 1e3 * float(np.linalg.norm(matrices[:, :3, 3] - expected, axis=-1).max()))
        difference = np.linalg.norm(
            matrices[:, :3, :3] - world[:3, :3] @ Z_UP @ frames.rotation.double().numpy(), axis=(1, 2)
        )
        angle = max(angle, float(np.degrees(2 * np.arcsin(np.minimum(difference / np.sqrt(8), 1))).max()))
    return distance, angle


def rendered(path: Path) -> tuple[np.ndarray, float]:
    """The scene's picture [H, W, 3] in 0 ... 1 as read from its PNG, and the seconds of the render."""
    began = time.perf_counter()
    bpy.ops.render.render()
    bpy.data.images["Render Result"].save_render(str(path))
    seconds = time.perf_counter() - began
    image = bpy.data.images.load(str(path))
    pixels = np.array(image.pixels[:], np.float32).reshape(SIZE, SIZE, 4)[..., :3]
    bpy.data.images.remove(image)
    return pixels, seconds


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * np.log10(((one.astype(np.float64) - other) ** 2).mean()))


def fitted_gains(primitives: Primitives) -> dict[str, float]:
    """The gain g with the least mean of |(1 - exp(-g s)) - min(s, 1)|, its mean, and that of DENSITY_GAIN.

    s is the sum of all opacities along a ray, which the marcher clamps to 1 (SPEC 4), of rays from four sides that
    meet the human: marched with so little density that no ray saturates.
    """
    faint = dataclasses.replace(primitives, density=primitives.density * FAINT)
    cameras = [framing(primitives, 90 * side, GAIN_PIXELS, GAIN_PIXELS) for side in range(4)]
    reached = np.concatenate([march(faint, camera).alpha.double().numpy().ravel() / FAINT for camera in cameras])
    met = reached[reached >= MET]
    errors = {gain: np.abs(-np.expm1(-gain * met) - np.minimum(met, 1)).mean() for gain in (*GAINS, DENSITY_GAIN)}
    best = min(GAINS, key=lambda gain: errors[gain])
    return {"gain_gain": best, "gain_error": errors[best], "gain_error_before": errors[DENSITY_GAIN]}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--pictures", type=Path, required=True, help="folder for the PNGs")
    parser.add_argument("--person", type=Path, help="a .human.safetensors; otherwise one is generated")
    parser.add_argument(
        "--no-volumes", action="store_true", help="skip the picture of 1024 volumes, which takes minutes"
    )
    arguments = parser.parse_args()
    human = load_human(arguments.person) if arguments.person else generate(load_checkpoint(None), SEED, STEPS)
    folder = arguments.pictures
    folder.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder.resolve() / "shot.blend"))
    blender_primdiffusion.register()
    save_human(folder / "person.human.safetensors", human)
    figures: dict[str, float | int | str | None] = {"size": SIZE, "samples": 1}
    before = psutil.Process().memory_info().rss
    began = time.perf_counter()
    person = build_human(bpy.context, folder / "person.human.safetensors")
    figures["build_seconds"] = time.perf_counter() - began
    set_representation(person, "VOLUMES")
    write_volumes(person)
    figures["seconds_write_volumes"] = time.perf_counter() - began - figures["build_seconds"]
    show_in_viewport(person, True)
    began = time.perf_counter()
    bpy.context.view_layer.update()
    figures["seconds_first_evaluation"] = time.perf_counter() - began
    armature = person
    strong = strong_poses(FRAMES)
    keyframe_poses(armature, np.arange(1, FRAMES + 1), strong, np.zeros((FRAMES, 3)))
    figures["frame_ms"] = frame_ms()
    figures["ram_per_human_mb"] = (psutil.Process().memory_info().rss - before) / 1e6
    figures["files_mb"] = sum(file.stat().st_size for file in files_of(person)) / 1e6
    figures["surface_error_mm_max"], figures["surface_error_deg_max"] = surface_error(human, armature, strong)

    armature.animation_data_clear()
    pose_from_joint_rotations(armature, step_pose())
    joints = pose_body(human.betas, BodyPose(torch.from_numpy(step_pose()).float(), torch.zeros(3))).skinning
    raised = torch.eye(3, 4)
    raised[1, 3] = float(model_origin(armature.data)[2])  # merged volumes are in the armature's space
    posed = PosedPerson(folder / "person.human.safetensors", raised.tolist(), joints[:, :3].tolist())
    session = Session()
    began = time.perf_counter()
    commands.merge(MergeRequest(people=[posed], out_dir=folder), session, lambda *_, **__: None)
    figures["seconds_merge"] = time.perf_counter() - began
    grid = merging.read_grid(folder / "0000.npz")
    began = time.perf_counter()
    digest = merging.write_grid(grid, folder / "grid.vdb")
    files = merging.publish([folder / "grid.vdb"], [digest], merging.merged_folder(person))
    figures |= {"seconds_write_merged": time.perf_counter() - began, "merged_mb": files[0].stat().st_size / 1e6}
    merging.show_merged(person, files, merging.MergedState(("",), grid.voxel))
    gains = fitted_gains(place_skinned(human, *(torch.tensor(numbers) for numbers in (posed.joints, posed.object))))
    figures |= gains

    setup_cycles_preview(bpy.context.scene, size=SIZE, samples=1, yaw=0.5, world=GREY)
    pictures = {}
    for name, gain in (("usual", DENSITY_GAIN), ("fitted", gains["gain_gain"])):
        bpy.data.materials[MATERIAL_NAME].node_tree.nodes[GAIN_NODE].outputs[0].default_value = gain
        set_representation(person, "MERGED")
        pictures[name], figures["seconds_cycles_merged"] = rendered(folder / f"merged_{name}.png")
    bpy.context.scene.render.engine = "PRIMDIFFUSION"
    bpy.context.scene.render.dither_intensity = 0
    rendered(folder / "exact.png")  # starts the child
    exact, figures["seconds_exact"] = rendered(folder / "exact.png")
    bpy.context.scene.render.engine = "CYCLES"
    for name, picture in pictures.items():
        figures[f"psnr_merged_{name}_exact"] = psnr(picture, exact)
    report(figures, arguments.json)
    if not arguments.no_volumes:
        set_representation(person, "VOLUMES")
        volumes, figures["seconds_cycles_volumes"] = rendered(folder / "volumes.png")
        figures["merged_speedup"] = figures["seconds_cycles_volumes"] / figures["seconds_cycles_merged"]
        figures["psnr_volumes_exact"] = psnr(volumes, exact)
        figures["psnr_merged_volumes"] = psnr(pictures["fitted"], volumes)
    blender_primdiffusion.unregister()
    report(figures, arguments.json)


if __name__ == "__main__":
    main()
