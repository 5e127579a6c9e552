"""What the engine's tests share: the backend as an oracle, Blender's camera by hand, pictures from files."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np

from blender_primdiffusion.scene import build

ROOT = Path(__file__).resolve().parents[2]
PYTHON = os.environ.get("PRIMDIFFUSION_PYTHON", sys.executable)
"""Runs the backend; Blender's own where that has torch."""
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Blender from backend."""
STEP = 0.004


class Oracle:
    """engine_oracle.py, kept running."""

    def __init__(self, folder: Path):
        command = [PYTHON, str(Path(__file__).with_name("engine_oracle.py"))]
        environment = {**os.environ, "PYTHONPATH": str(ROOT / "backend")}
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, env=environment, text=True)
        self._out = folder / "oracle.npz"

    def ask(self, request: dict) -> None:
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        assert self._process.stdout.readline().strip() == "{}"

    def make(self, folder: Path, seed: int = 1, betas: Sequence[float] = (0.0,) * 10) -> Path:
        """Write a human to a folder."""
        self.ask({"make": str(folder), "seed": seed, "betas": list(betas)})
        return folder

    def picture(
        self, people: list[dict], camera: dict, size: tuple[int, int], step: float = STEP, **more: object
    ) -> tuple[np.ndarray, np.ndarray]:
        """Combined [h, w, 4] and depth [h, w], top row first."""
        draw = {"people": people, **camera, "width": size[0], "height": size[1], "step": step, **more}
        self.ask({"draw": draw, "out": str(self._out)})
        with np.load(self._out) as answer:
            return answer["combined"], answer["depth"]

    def close(self) -> None:
        self._process.stdin.close()
        self._process.wait()


def add_human(folder: Path) -> bpy.types.Object:
    """Build the human of `Oracle.make`."""
    return build.build_human(bpy.context, folder / "person.human.safetensors")


def set_up_render(
    scene: bpy.types.Scene, size: tuple[int, int], location: Sequence[float], rotation: Sequence[float]
) -> bpy.types.Object:
    """The engine, a transparent film, colours as they are, and a new camera."""
    scene.render.engine = "PRIMDIFFUSION"
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.film_transparent = True
    scene.render.dither_intensity = 0
    scene.view_settings.view_transform = "Standard"
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.camera.location, scene.camera.rotation_euler = location, rotation
    scene.collection.objects.link(scene.camera)
    return scene.camera


def cube(name="cube", centre=(0.0, 0.0, 1.0), half=0.2) -> bpy.types.Object:
    """A mesh of twelve triangles in the scene; `half` an edge long to each side."""
    mesh = bpy.data.meshes.new(name)
    corners = [(x, y, z) for x in (-half, half) for y in (-half, half) for z in (-half, half)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    mesh.from_pydata(corners, [], faces)
    obj = bpy.data.objects.new(name, mesh)
    obj.location = centre
    bpy.context.scene.collection.objects.link(obj)
    return obj


def material(colour, name="paint") -> bpy.types.Material:
    """A Principled shader of this linear colour."""
    made = bpy.data.materials.new(name)
    shader = next(node for node in made.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Base Color"].default_value = (*colour, 1)
    return made


def camera_by_hand(camera: bpy.types.Object, size: tuple[int, int], aspect: tuple[float, float] = (1, 1)) -> dict:
    """Blender's perspective camera as its manual describes it, OpenCV in the backend's axes.

    The sensor's width, or for a vertical fit its height, is what the fitted side of the picture sees through the lens;
    shift counts in lengths of that side.
    """
    data, (width, height) = camera.data, size
    tall = aspect[1] / aspect[0]  # a pixel's height in widths
    fit = data.sensor_fit
    if fit == "AUTO":
        fit = "HORIZONTAL" if width >= height * tall else "VERTICAL"
    sensor = data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width
    side = width if fit == "HORIZONTAL" else height * tall  # in widths of a pixel
    focal = data.lens / sensor * side
    intrinsics = [
        [focal, 0, width / 2 - data.shift_x * side],
        [0, focal / tall, height / 2 + data.shift_y * side / tall],
        [0, 0, 1],
    ]
    world = np.array(camera.matrix_world)
    axes = world[:3, :3] / np.linalg.norm(world[:3, :3], axis=0)
    to_camera = np.stack([axes[:, 0], -axes[:, 1], -axes[:, 2]])
    rows = np.concatenate([to_camera @ Z_UP[:3, :3], -(to_camera @ world[:3, 3])[:, None]], 1)
    return {"intrinsics": np.array(intrinsics).tolist(), "world_to_camera": rows.tolist()}


def eight_bit(combined: np.ndarray) -> np.ndarray:
    """What a PNG holds [h, w, 4]: straight sRGB and alpha, 0 ... 255."""
    alpha = combined[..., 3:]
    straight = np.clip(combined[..., :3] / np.where(alpha > 0, alpha, 1), 0, 1)
    encoded = np.where(straight <= 0.0031308, 12.92 * straight, 1.055 * straight ** (1 / 2.4) - 0.055)
    return np.round(255 * np.concatenate([encoded, np.clip(alpha, 0, 1)], -1))


def render_png(path: Path, mode: str = "RGBA") -> np.ndarray:
    """F12 into a PNG [h, w, 4], 0 ... 255, top row first."""
    scene = bpy.context.scene
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = mode
    scene.render.filepath = str(path)
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    return np.round(255 * pixels(path))


def render_exr(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """F12 into EXRs: combined [h, w, 4] and depth [h, w], top row first."""
    scene = bpy.context.scene
    for layer in scene.view_layers:
        layer.use_pass_z = True
    settings = scene.render.image_settings
    settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
    scene.render.filepath = str(path)
    assert bpy.ops.render.render(write_still=True) == {"FINISHED"}
    return read_layers(path)


def pixels(path: Path) -> np.ndarray:
    image = bpy.data.images.load(str(path))
    try:
        width, height = image.size
        return np.array(image.pixels[:]).reshape(height, width, 4)[::-1]
    finally:
        bpy.data.images.remove(image)


def read_layers(path: Path, layer: str = "ViewLayer") -> tuple[np.ndarray, np.ndarray]:
    """Combined and depth of a view layer in a multilayer EXR."""
    bpy.utils.expose_bundled_modules()
    import OpenImageIO  # Blender's own, importable only after the line above

    values = {}
    for part in range(OpenImageIO.ImageBuf(str(path)).nsubimages):  # Blender 5 writes a part for each pass
        image = OpenImageIO.ImageBuf(str(path), part, 0)
        names = image.spec().channelnames
        values |= dict(zip(names, np.moveaxis(image.get_pixels(OpenImageIO.FLOAT), -1, 0), strict=True))
    return np.stack([values[f"{layer}.Combined.{c}"] for c in "RGBA"], -1), values[f"{layer}.Depth.Z"]
