"""Draws the documentation's picture of the render engine: a person among solids in each view, and over Cycles.

`python benchmarks/engine_pictures.py --out docs/pictures/engine.png` renders through Blender as a Python module. The
last panel is made as the documentation describes: Cycles draws the solids, the engine draws the people with holdouts,
and these are composited over the solids.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from pathlib import Path

import blender_isolated  # noqa: F401  before bpy
import bpy
import numpy as np
from march_people import generated
from PIL import Image
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.human_file import export_for_blender, save_human

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from walk import walk_and_wave

import blender_primdiffusion
from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import armature_of

ROOT = Path(__file__).resolve().parents[1]
WIDTH, HEIGHT = 300, 420
FRAMES, SHOWN = 48, 31
SKY = (0.55, 0.6, 0.66)
SAMPLES = 64


def stage(folder: Path, seed: int) -> bpy.types.Collection:
    """Set up a person who walks and waves between two cubes and a ball on a floor, and a camera; returns the person."""
    human = generated((seed,))[0]
    save_human(folder / "person.human.safetensors", human)
    export_for_blender(folder / "human.npz", human)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"))
    person = build_human(bpy.context, folder / "human.npz", keep=[folder / "person.human.safetensors"])
    pose_from_joint_rotations(armature_of(person), walk_and_wave(FRAMES)[SHOWN])
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
    if bpy.app.version < (5, 0):
        scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (*SKY, 1)
    return person


def paint(colour: tuple[float, float, float]) -> None:
    """Give the active object a material of this linear colour."""
    material = bpy.data.materials.new("paint")
    if bpy.app.version < (5, 0):
        material.use_nodes = True
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*colour, 1)
    bpy.context.object.data.materials.append(material)


def picture(folder: Path) -> np.ndarray:
    """Render the scene: linear, premultiplied [h, w, 4]."""
    render = bpy.context.scene.render
    render.image_settings.file_format, render.image_settings.color_mode = "OPEN_EXR", "RGBA"
    render.filepath = str(folder / "picture.exr")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(render.filepath)
    try:
        return np.array(image.pixels[:]).reshape(HEIGHT, WIDTH, 4)[::-1]
    finally:
        bpy.data.images.remove(image)


def over_cycles(person: bpy.types.Collection, folder: Path) -> np.ndarray:
    """The engine's people over Cycles' solids; the hidden body mesh casts its shadow on them."""
    scene = bpy.context.scene
    scene.render.film_transparent = True
    scene.primdiffusion_render.solids = "HOLDOUT"
    above = picture(folder)
    scene.render.film_transparent = False
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.device = SAMPLES, "CPU"
    layer = bpy.context.view_layer.layer_collection.children[person.name]
    next(child for child in layer.children if child.name.endswith("_primitives")).exclude = True
    body = next(obj for obj in person.objects if obj.type == "MESH")
    body.hide_render = body.visible_camera = False
    below = picture(folder)
    return above + (1 - above[..., 3:]) * below


def main() -> None:
    """Renders the panels and saves them side by side."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "pictures" / "engine.png")
    parser.add_argument("--seed", type=int, default=7)
    arguments = parser.parse_args()
    blender_primdiffusion.register()
    with tempfile.TemporaryDirectory(prefix="primdiffusion_pictures_") as folder:
        person = stage(Path(folder), arguments.seed)
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
    main()
