"""Measures the overhead of Blender's render engine over the marcher, and compares its pictures to the backend's.

`python benchmarks/engine.py --json engine.json` renders one person at 512 x 512 through Blender (as a Python module)
and the engine's warm child. Milliseconds are wall time, the best of several frames; for `_new_pose` figures the
armature is posed before every frame, otherwise only the camera moves. engine_overhead_ms is the time in
RenderEngine.render without the child's march. engine_pixel_error_max is the largest difference between an 8-bit PNG and
the backend's own picture, with pixel values in 0 ... 1.

`python benchmarks/engine.py pictures --out docs/pictures/engine.png` draws the documentation's picture: a person among
solids in each view, and over Cycles. The last panel is made as the documentation describes: Cycles draws the solids,
the engine draws the people with holdouts, and these are composited over the solids.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import blender_isolated  # noqa: F401  before bpy
import bpy
import numpy as np
import torch
from march_people import checkered_human, generated
from PIL import Image
from primdiffusion.body.model import BodyPose
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.geometry.rotation import axis_angle_to_matrix
from primdiffusion.human import Human, place
from primdiffusion.human_file import save_human
from primdiffusion.render.march import march
from record import command_line, report, run

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from walk import walk_and_wave

import blender_primdiffusion
from blender_primdiffusion.engine import engine
from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import body_of
from blender_primdiffusion.scene.place import is_solid

SIZE = 512
WARM_UP, FRAMES = 3, 15
DISTANCE_M, LENS_MM, SENSOR_MM = 3.2, 50.0, 36.0
BACKEND_FROM_BLENDER = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
ROOT = Path(__file__).resolve().parents[1]
WIDTH, HEIGHT = 300, 420
WALK_FRAMES, SHOWN = 48, 31
SKY = (0.55, 0.6, 0.66)
CYCLES_SAMPLES = 64


def stage(human: Human, folder: Path) -> bpy.types.Object:
    """Set up a scene with the person, all 1024 volumes included, and a camera in front; returns the armature."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"))
    save_human(folder / "person.human.safetensors", human)
    person = build_human(bpy.context, folder / "person.human.safetensors")
    scene = bpy.context.scene
    scene.render.engine = "PRIMDIFFUSION"
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.film_transparent = True
    scene.render.dither_intensity = 0
    scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "PNG", "RGBA"
    scene.view_settings.view_transform = "Standard"
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.camera.data.lens, scene.camera.data.sensor_width = LENS_MM, SENSOR_MM
    scene.camera.rotation_euler = (np.pi / 2, 0, 0)
    scene.collection.objects.link(scene.camera)
    scene.camera.location = (0.0, -DISTANCE_M, 1.0)
    return person


def pose(seed: int) -> np.ndarray:
    """Joint rotations [24, 3, 3] of a random small motion."""
    turns = np.random.default_rng(seed).normal(0, 0.15, (24, 3))
    return axis_angle_to_matrix(torch.from_numpy(turns).float()).double().numpy()


@contextmanager
def timed(module: object, name: str, seconds: list[float]) -> Iterator[None]:
    """Appends the duration of each call of a function to `seconds` while the block runs."""
    plain: Callable = getattr(module, name)

    def wrapped(*arguments: object, **named: object) -> object:
        began = time.perf_counter()
        try:
            return plain(*arguments, **named)
        finally:
            seconds.append(time.perf_counter() - began)

    setattr(module, name, wrapped)
    try:
        yield
    finally:
        setattr(module, name, plain)


def overhead(change: Callable[[int], None]) -> dict[str, float]:
    """Milliseconds of each part of the frame with the least overhead; `change(i)` is called before frame i."""
    drawings: list = []
    plain = engine.render_layer

    def recorded(engine: object, depsgraph: object) -> object:
        drawings.append(plain(engine, depsgraph))
        return drawings[-1]

    whole, gather, fill = [], [], []
    engine.render_layer = recorded
    try:
        with (
            timed(engine, "render_layer", whole),
            timed(engine, "scene_content", gather),
            timed(engine, "scene_solids", gather),
            timed(engine, "_fill", fill),
        ):
            for frame in range(WARM_UP + FRAMES):
                change(frame)
                bpy.ops.render.render()
    finally:
        engine.render_layer = plain
    rows = []
    for frame in range(WARM_UP, WARM_UP + FRAMES):
        child = drawings[frame].result
        parts = {
            "render": whole[frame],
            "march": child.seconds_march,
            "place": child.seconds_place,
            "rest_of_child": child.seconds - child.seconds_place - child.seconds_march,
            "gather": gather[2 * frame] + gather[2 * frame + 1],
            "fill": fill[frame],
        }
        parts["conversation"] = parts["render"] - child.seconds - parts["gather"] - parts["fill"]
        rows.append({"overhead": parts["render"] - parts["march"], **parts})
    best = min(rows, key=lambda row: row["overhead"])
    best["overhead_median"] = float(np.median([row["overhead"] for row in rows]))
    return {f"{name}_ms": 1e3 * value for name, value in best.items()}


def rendered(path: Path) -> bpy.types.Image:
    """Render the scene to a file, and load that."""
    bpy.ops.render.render()
    bpy.data.images["Render Result"].save_render(str(path))
    return bpy.data.images.load(str(path))


def pixel_error(human: Human, armature: bpy.types.Object, rotations: np.ndarray, folder: Path) -> float:
    """The largest difference between Blender's saved PNG and the backend's picture, pixel values in 0 ... 1."""
    pose_from_joint_rotations(armature, rotations)
    image = rendered(folder / "picture.png")
    given = np.round(255 * np.array(image.pixels[:])).reshape(SIZE, SIZE, 4)[::-1]
    focal = LENS_MM / SENSOR_MM * SIZE
    eye = BACKEND_FROM_BLENDER @ (np.array(bpy.context.scene.camera.location) - np.array(armature.location))
    to_camera = np.diag([1.0, -1.0, -1.0])  # the camera looks along -z of the backend, at the person's face
    camera = Camera(
        torch.tensor([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]]),
        torch.from_numpy(np.concatenate([to_camera, -(to_camera @ eye)[:, None]], 1)).float(),
        SIZE,
        SIZE,
    )
    body_pose = BodyPose(torch.from_numpy(rotations).float(), torch.zeros(3))
    rendering = march(place(human, body_pose), camera)
    alpha = rendering.alpha[..., None]
    straight = (rendering.rgb / torch.where(alpha > 0, alpha, 1)).clamp(0, 1)
    expected = np.concatenate([np.asarray(encode_srgb(straight.numpy())), alpha.numpy()], -1)
    return float(np.abs(given - np.round(255 * expected)).max() / 255)


def main() -> None:
    parser = command_line(__doc__)
    arguments = parser.parse_args()
    human = checkered_human()
    blender_primdiffusion.register()
    with tempfile.TemporaryDirectory(prefix="primdiffusion_benchmark_") as folder:
        armature = stage(human, Path(folder))
        figures: dict[str, float | int | str | None] = {"size": SIZE, "frames": FRAMES}
        figures["engine_pixel_error_max"] = max(
            pixel_error(human, armature, pose(seed), Path(folder)) for seed in range(3)
        )
        camera = bpy.context.scene.camera
        moved = overhead(lambda frame: setattr(camera.location, "x", 0.01 * frame))
        posed = overhead(lambda frame: pose_from_joint_rotations(armature, pose(frame)))
        figures |= {f"engine_{name}": value for name, value in moved.items()}
        figures |= {f"engine_new_pose_{name}": value for name, value in posed.items()}
        blender_primdiffusion.unregister()
    report(figures, arguments.json)


def picture_stage(folder: Path, seed: int) -> bpy.types.Collection:
    """Set up a person who walks and waves between two cubes and a ball on a floor, and a camera; returns the person."""
    human = generated((seed,))[0]
    save_human(folder / "person.human.safetensors", human)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"))
    person = build_human(bpy.context, folder / "person.human.safetensors")
    pose_from_joint_rotations(person, walk_and_wave(WALK_FRAMES)[SHOWN])
    bpy.ops.mesh.primitive_plane_add(size=40)
    paint((0.5, 0.48, 0.45))
    bpy.ops.mesh.primitive_cube_add(size=0.35, location=(0.42, -0.5, 0.175), rotation=(0, 0, 0.4))
    paint((0.75, 0.1, 0.06))
    bpy.ops.mesh.primitive_cube_add(size=0.9, location=(-0.4, 0.75, 0.45), rotation=(0, 0, 0.2))
    paint((0.06, 0.25, 0.6))
    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.12, location=(0.2, -0.35, 1.0), segments=48, ring_count=24)
    paint((0.8, 0.55, 0.05))
    bpy.ops.object.light_add(type="SUN", rotation=(0.7, 0.25, 0.5))
    bpy.context.object.data.energy = 1.5
    bpy.ops.object.camera_add(location=(0.0, -3.9, 1.15), rotation=(math.radians(86), 0, 0))
    scene = bpy.context.scene
    scene.camera = bpy.context.object
    scene.render.resolution_x, scene.render.resolution_y = WIDTH, HEIGHT
    scene.view_settings.view_transform = "Standard"
    scene.render.dither_intensity = 0
    scene.world = bpy.data.worlds.new("Sky")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (*SKY, 1)
    return person


def paint(colour: tuple[float, float, float]) -> None:
    """Give the active object a material of this linear colour."""
    material = bpy.data.materials.new("paint")
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*colour, 1)
    bpy.context.object.data.materials.append(material)


def picture(folder: Path) -> np.ndarray:
    """Render the scene: linear, premultiplied [h, w, 4]."""
    render = bpy.context.scene.render
    render.image_settings.file_format, render.image_settings.color_mode = "OPEN_EXR", "RGBA"
    image = rendered(folder / "picture.exr")
    try:
        return np.array(image.pixels[:]).reshape(HEIGHT, WIDTH, 4)[::-1]
    finally:
        bpy.data.images.remove(image)


def over_cycles(person: bpy.types.Object, folder: Path) -> np.ndarray:
    """The engine's people over Cycles' solids; the hidden body mesh casts its shadow on them."""
    scene = bpy.context.scene
    scene.render.film_transparent = True
    solids = [obj for obj in scene.objects if is_solid(obj)]
    for obj in solids:
        obj.is_holdout = True
    above = picture(folder)
    for obj in solids:
        obj.is_holdout = False
    scene.render.film_transparent = False
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.device = CYCLES_SAMPLES, "CPU"
    for part in person.children:
        part.hide_render = True
    body = body_of(person)
    body.hide_render = body.visible_camera = False
    below = picture(folder)
    return above + (1 - above[..., 3:]) * below


def pictures() -> None:
    """Renders the panels and saves them side by side."""
    parser = argparse.ArgumentParser(description=pictures.__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "pictures" / "engine.png")
    parser.add_argument("--seed", type=int, default=7)
    arguments = parser.parse_args()
    blender_primdiffusion.register()
    with tempfile.TemporaryDirectory(prefix="primdiffusion_pictures_") as folder:
        person = picture_stage(Path(folder), arguments.seed)
        scene, panels = bpy.context.scene, []
        scene.render.engine = "PRIMDIFFUSION"
        for view in ("COLOUR", "DEPTH", "ALPHA", "BOXES"):
            scene.primdiffusion_render.view = view
            panels.append(picture(Path(folder)))
        scene.primdiffusion_render.view = "COLOUR"
        panels.append(over_cycles(person, Path(folder)))
        blender_primdiffusion.unregister()
    sheet = np.asarray(encode_srgb(np.clip(np.concatenate(panels, 1)[..., :3], 0, 1)))
    Image.fromarray(np.round(255 * sheet).astype(np.uint8)).save(arguments.out, optimize=True)


if __name__ == "__main__":
    run(main, pictures=pictures)
