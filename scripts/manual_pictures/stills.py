"""Stills of the manual: the engine and Cycles, a group, a re-dressed and a reshaped person, library poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bpy
from PIL import Image

from .shrink import save_jpeg
from .stage import empty_file, generate, look, pose, render, tiled_floor

SIZE = (360, 480)
_STAND, _AT, _LENS = (1.1, -5.2, 1.25), (0.0, 0.0, 0.88), 78.0
_TILE = 0.5


def stills(scratch: Path, out: Path, only: list[str]) -> None:
    for name, still in STILLS.items():
        if not only or name in only:
            folder = scratch / name
            folder.mkdir()
            save_jpeg(_row(still(folder)), out / f"{name}.jpg")


def engine_and_cycles(folder: Path) -> list[Path]:
    """One person drawn by the engine, and merged in Cycles with an object that reflects them."""
    scene = _stage(folder, 3, "Hands on Hips")
    exact = render(scene, folder / "engine.png", SIZE)
    scene.primdiffusion_merging.voxel = 0.005
    bpy.ops.primdiffusion.merge()
    bpy.ops.primdiffusion.set_up_engine(engine="CYCLES")
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.rotation_euler = (0.6, 0.3, 0.4)
    sun.data.energy = 2.5
    scene.collection.objects.link(sun)
    scene.cycles.samples = 32
    return [exact, render(scene, folder / "cycles.png", SIZE)]


def group(folder: Path) -> list[Path]:
    """Six people in poses of the library."""
    scene = empty_file(folder / "group.blend")
    people = (
        (12, "Waving"),
        (27, "Arms Crossed"),
        (3, "Hands on Hips"),
        (23, "Cheering"),
        (22, "Thinking"),
        (0, "Relaxed"),
    )
    for number, (seed, name) in enumerate(people):
        row = number % 2
        pose(generate(seed, ((number - 2.5) * 0.62, 0.35 - row * 0.7)), name)
    tiled_floor(scene, _TILE)
    look(scene, (1.0, -8.2, 1.6), (0.0, 0.0, 0.93), 70)
    return [render(scene, folder / "group.png", (840, 480))]


def redressed(folder: Path) -> list[Path]:
    """One person, then in a suit, then in a tee and shorts."""
    scene = _stage(folder, 10, "Contrapposto")
    pictures, settings = [render(scene, folder / "before.png", SIZE)], scene.primdiffusion_edit
    for number, (parts, outfit) in enumerate((({"clothes"}, "suit"), ({"clothes"}, "tee and shorts"))):
        settings.parts, settings.attributes.outfit = parts, outfit
        bpy.ops.primdiffusion.redress(seed=5)
        pictures.append(render(scene, folder / f"after{number}.png", SIZE))
    return pictures


def reshaped(folder: Path) -> list[Path]:
    """One person, then shorter and heavier, then taller and lighter."""
    scene = _stage(folder, 12, "Relaxed")
    pictures = []
    for number, (height, weight) in enumerate(((1.55, 80.0), (1.72, 68.0), (1.9, 75.0))):
        settings = bpy.context.object.primdiffusion_human
        settings.height = height
        settings.weight = weight
        pictures.append(render(scene, folder / f"{number}.png", SIZE))
    return pictures


def _stage(folder: Path, seed: int, name: str) -> bpy.types.Scene:
    scene = empty_file(folder / "still.blend")
    person = generate(seed)
    pose(person, name)
    tiled_floor(scene, _TILE)
    look(scene, _STAND, _AT, _LENS)
    bpy.context.view_layer.objects.active = person
    return scene


def _row(paths: list[Path]) -> Image.Image:
    pictures = [Image.open(path).convert("RGB") for path in paths]
    row = Image.new("RGB", (sum(p.width for p in pictures), max(p.height for p in pictures)))
    x = 0
    for picture in pictures:
        row.paste(picture, (x, 0))
        x += picture.width
    return row


STILLS: dict[str, Callable[[Path], list[Path]]] = {
    "engine_and_cycles": engine_and_cycles,
    "group": group,
    "redressed": redressed,
    "reshaped": reshaped,
}
