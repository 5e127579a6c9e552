"""Initial states of scenes: Blender's factory scene, people in an empty one, one of them selected, no job running."""

from __future__ import annotations

import copy
from importlib import import_module
from pathlib import Path

import bpy
from panels import view
from press import Steps, press, wait

FIRST_SEED, SECOND_SEED = 10, 53
_MOST_S = 1500.0
_VIEW = ("view_perspective", "view_location", "view_rotation", "view_distance")
_first_view: dict[str, object] = {}
"""Of the 3D view as Blender started: reading the factory scene leaves it turned as the scene before has."""


def begin(module: str, python: str) -> Steps:
    """As Blender starts: a cube, a light and a camera; without a backend where `python` is empty."""
    around = view()[1].spaces.active.region_3d
    if not _first_view:
        _first_view.update({name: copy.copy(getattr(around, name)) for name in _VIEW})
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    around = view()[1].spaces.active.region_3d
    for name, value in _first_view.items():
        setattr(around, name, value)
    queue_of(module).outcomes.clear()
    yield 1.5
    bpy.context.preferences.addons[module].preferences.backend_python = python


def with_people(module: str, python: str, *seeds: int) -> Steps:
    """A file with these people and nothing solid, to which scenes add what they need; they are generated once."""
    yield from begin(module, python)
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    path = people_file(module, len(seeds))
    if path.is_file():
        bpy.ops.wm.open_mainfile(filepath=str(path), load_ui=False)
    else:
        for seed in seeds:
            if press("primdiffusion.generate", seed=seed) == {"CANCELLED"}:
                raise RuntimeError("the button Generate is rejected: see the line above")
        yield from wait(lambda: not queue_of(module).busy, _MOST_S)
        if len(armatures()) < len(seeds):
            failures = [ended.sentence for ended in queue_of(module).ended if ended.error is not None]
            why = failures[0] if failures else f"not within {_MOST_S:.0f} s"
            raise RuntimeError(f"the humans were not generated: {why}")
        bpy.ops.wm.save_as_mainfile(filepath=str(path))
    yield 1.0
    select(armatures()[0])


def clear_of_the_sidebar() -> None:
    """Move the second of two people to the left of the first one, as `wide_view` sees them."""
    first, second = armatures()
    second.location.xy = first.location.x - 1.8, first.location.y


def people_file(module: str, count: int = 1) -> Path:
    """A file in the installed extension's folder, which is deleted with it."""
    folder = Path(import_module(module).__file__).parents[3]
    return folder / f"people_{count}.blend"


def queue_of(module: str):
    return import_module(f"{module}.jobs.queue").queue


def cancel_all(module: str) -> Steps:
    queue = queue_of(module)
    while queue.busy:
        if queue.current is not None:  # none is between two jobs
            press("primdiffusion.cancel")
        yield 0.3


def armatures() -> list[bpy.types.Object]:
    """The people's armatures, in the order they were generated."""
    return sorted((obj for obj in bpy.context.scene.objects if obj.type == "ARMATURE"), key=lambda t: t.name)


def select(armature: bpy.types.Object) -> None:
    """Select the person that the panels show."""
    for obj in bpy.context.view_layer.objects:
        obj.select_set(False)
    armature.select_set(True)
    bpy.context.view_layer.objects.active = armature
