"""What scenes begin with: a new file, people in it, one of them selected, nothing at work."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import bpy
from press import Steps, press, wait


def begin(module: str, python: str) -> Steps:
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    yield 1.5
    bpy.context.preferences.addons[module].preferences.backend_python = python
    for thing in list(bpy.data.objects):
        if thing.type == "MESH":
            bpy.data.objects.remove(thing)


def with_people(module: str, python: str, *seeds: int) -> Steps:
    """A file with these people, made once."""
    yield from begin(module, python)
    path = people_file(module, len(seeds))
    if path.is_file():
        bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False)
    else:
        for seed in seeds:
            press("primdiffusion.generate", seed=seed)
        yield from wait(lambda: not queue_of(module).busy, 400)
        bpy.ops.wm.save_as_mainfile(filepath=str(path))
    leave_out_volumes()
    yield 1.0
    select(armatures()[0])


def leave_out_volumes() -> None:
    """Out of the view layer: the engine does not need them, and each person's take a gigabyte."""
    waiting = [bpy.context.view_layer.layer_collection]
    while waiting:
        layer = waiting.pop()
        waiting += layer.children
        if layer.name.endswith("_primitives"):
            layer.exclude = True


def people_file(module: str, count: int = 1) -> Path:
    """Beside the installed extension: gone with it."""
    folder = Path(import_module(module).__file__).parents[3]
    return folder / f"people_{count}.blend"


def queue_of(module: str):
    return import_module(f"{module}.jobs.queue").queue


def cancel_all(module: str) -> Steps:
    queue = queue_of(module)
    while queue.busy:
        press("primdiffusion.cancel")
        yield 0.3


def armatures() -> list[bpy.types.Object]:
    """Of the people, in the order of their making."""
    return sorted((thing for thing in bpy.context.scene.objects if thing.type == "ARMATURE"), key=lambda t: t.name)


def select(armature: bpy.types.Object) -> None:
    """The person of whom the panels tell."""
    for thing in bpy.context.view_layer.objects:
        thing.select_set(False)
    armature.select_set(True)
    bpy.context.view_layer.objects.active = armature
