"""Compares a human's splats in Cycles with the engine, and measures what they cost; needs Blender 5.3 or newer.

`python benchmarks/splats.py --json splats.json --pictures DIR` shows the sample human at rest, from the front and the
side, 512 x 512. splat_psnr is that of Cycles (128 samples) against the engine, over the pixels of the figure, the worse
of the two views; splat_cycles_cpu_seconds is a frame of 16 samples. splat_update_ms is the fastest evaluation of a new
pose. crowd_people are instances of one human, which crowd.png shows.

The constants of `scene/splats.py` were fitted to one view each of four people, the sample human among them.
`--human FILE --yaw DEGREES DEGREES` measures others, without the crowd.
"""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path

import blender_isolated  # noqa: F401  before bpy
import bpy
import numpy as np
from record import command_line, report

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from cycles_preview import setup_cycles_preview

import blender_primdiffusion
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.splats import SPLATS_AVAILABLE

SIZE, GREY = 512, 0.5
SAMPLES, QUICK_SAMPLES = 128, 16
CROWD = (10, 5)
POSES = 100
SAMPLE = Path(blender_primdiffusion.__file__).parent / "gallery" / "Sample.human"


def rendered(path: Path) -> tuple[np.ndarray, float]:
    """The scene's picture [SIZE, SIZE, 4] in 0 ... 1 and the CPU seconds of the render."""
    began = time.process_time()
    bpy.ops.render.render()
    seconds = time.process_time() - began
    bpy.data.images["Render Result"].save_render(str(path))
    image = bpy.data.images.load(str(path))
    pixels = np.array(image.pixels[:], np.float32).reshape(image.size[1], image.size[0], 4)
    bpy.data.images.remove(image)
    return pixels, seconds


def psnr_over_figure(picture: np.ndarray, exact: np.ndarray) -> float:
    """Over GREY in both, of the pixels that the exact figure covers at all."""
    figure = exact[..., 3] > 1 / 255
    over_grey = [image[..., :3] * image[..., 3:] + GREY * (1 - image[..., 3:]) for image in (picture, exact)]
    return float(-10 * np.log10(((over_grey[0] - over_grey[1])[figure] ** 2).mean()))


def update_ms(person: bpy.types.Object) -> float:
    """Milliseconds of the fastest evaluation of a new pose; the fastest, as other programs only add time."""
    bone = person.pose.bones["right_hip"]
    bone.rotation_mode = "XYZ"
    times = []
    for number in range(POSES):
        bone.rotation_euler[0] = -0.05 * number
        began = time.perf_counter()
        bpy.context.view_layer.update()
        times.append(time.perf_counter() - began)
    bone.rotation_euler[0] = 0.0
    return 1e3 * min(times)


def crowd(person: bpy.types.Object) -> int:
    """Instances of the human's collection in rows behind it; returns how many people there are."""
    (collection,) = (one for one in person.users_collection if not one.hide_viewport)
    rows = [(x, y) for x in range(CROWD[0]) for y in range(CROWD[1])][1:]
    for x, y in rows:
        empty = bpy.data.objects.new("Person", None)
        empty.instance_type, empty.instance_collection = "COLLECTION", collection
        empty.location, empty.rotation_euler[2] = (0.9 * x, 1.1 * y, 0.0), 0.6 * math.sin(7 * x + 3 * y)
        bpy.context.scene.collection.objects.link(empty)
    return 1 + len(rows)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--pictures", type=Path, required=True, help="folder for the PNGs")
    parser.add_argument("--human", type=Path, default=SAMPLE, help="a .human file; default: the sample human")
    parser.add_argument("--yaw", type=float, nargs=2, default=(0.0, 60.0), help="degrees of the two views")
    arguments = parser.parse_args()
    if not SPLATS_AVAILABLE:
        sys.exit("splats need Blender 5.3 or newer: run this in .venv53")
    folder = arguments.pictures
    folder.mkdir(parents=True, exist_ok=True)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    blend = folder.resolve() / "shot.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    empty_bytes = blend.stat().st_size
    blender_primdiffusion.register()
    scene = bpy.context.scene
    began = time.perf_counter()
    person = build_human(bpy.context, arguments.human)
    figures: dict[str, float | int | str | None] = {"add_human_seconds": time.perf_counter() - began, "size": SIZE}
    figures["objects_of_a_human"] = len(bpy.data.objects)
    bpy.ops.wm.save_mainfile(compress=True)
    figures["blend_mb_a_human"] = (blend.stat().st_size - empty_bytes) / 1e6
    figures["splat_update_ms"] = update_ms(person)
    report(figures, arguments.json)

    worst = math.inf
    for name, yaw in zip(("front", "side"), map(math.radians, arguments.yaw), strict=True):
        setup_cycles_preview(scene, size=SIZE, samples=QUICK_SAMPLES, yaw=yaw, world=None)
        scene.render.dither_intensity = 0
        scene.render.engine = "PRIMDIFFUSION"
        exact, _ = rendered(folder / f"exact_{name}.png")
        scene.render.engine = "CYCLES"
        _, figures["splat_cycles_cpu_seconds"] = rendered(folder / f"splats_{name}_quick.png")
        scene.cycles.samples = SAMPLES
        picture, _ = rendered(folder / f"splats_{name}.png")
        worst = min(worst, psnr_over_figure(picture, exact))
    figures["splat_psnr"] = worst
    report(figures, arguments.json)

    if arguments.human != SAMPLE:
        blender_primdiffusion.unregister()
        return
    figures["crowd_people"] = crowd(person)
    scene.camera.location, scene.camera.rotation_euler = (4.05, -11.0, 5.0), (math.radians(71), 0.0, 0.0)
    scene.camera.data.lens = 50
    bpy.ops.mesh.primitive_plane_add(size=60, location=(4, 10, 0))
    bpy.ops.object.light_add(type="SUN", rotation=(0.7, 0.4, 0.0))
    bpy.context.object.data.energy = 3.0
    scene.world = bpy.data.worlds.new("Sky")
    scene.render.film_transparent = False
    scene.render.resolution_x, scene.cycles.samples = 2 * SIZE, QUICK_SAMPLES
    _, figures["crowd_cycles_cpu_seconds"] = rendered(folder / "crowd.png")
    blender_primdiffusion.unregister()
    report(figures, arguments.json)


if __name__ == "__main__":
    main()
