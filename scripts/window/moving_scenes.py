"""Scenes of views that change: how soon humans are seen after a .blend is opened and after the view has turned, and
what a turning view and an animation cost (see `scenes.py`)."""

from __future__ import annotations

import json
import statistics
import subprocess
import time
from importlib import import_module
from pathlib import Path

import bpy
from mathutils import Quaternion
from panels import view, wide_view
from press import Steps, press, wait
from start import FIRST_SEED, SECOND_SEED, armatures, people_file, select, with_people
from view_scenes import finish, finished_ms, redraw_view

OPENED = Path(__file__).with_name("opened.py")
"""Runs in a Blender of its own: shaders and modules of this one are ready."""
ROUNDS, STEPS = 4, 8
TURN = 0.06
"""Radians a step."""


def opening(module: str, python: str) -> Steps:
    """A Blender opens a file with a human: how soon it is in view, what is seen then, and how fine it becomes."""
    yield from with_people(module, python, FIRST_SEED)
    wide_view()
    view()[1].spaces.active.shading.type = "SOLID"
    yield 1.0
    path = people_file(module)
    bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True)
    found = path.with_suffix(".json")
    command = [bpy.app.binary_path, "--gpu-backend", "opengl", "--window-geometry", "0", "0", "1600", "1400"]
    blender = subprocess.Popen([*command, "--python", str(OPENED), "--", module, str(path), str(found)])
    yield from wait(found.is_file, 120)
    yield "opening_at_once"
    yield from wait(lambda: blender.poll() is not None, 240)
    yield {"figures": json.loads(found.read_text(encoding="utf-8"))}


def turning(module: str, python: str) -> Steps:
    """Measures redraws of a turning view against an empty scene's, and how soon it is whole when it stops."""
    yield from with_people(module, python, FIRST_SEED)
    wide_view()
    space = view()[1].spaces.active
    space.shading.type, around = "SOLID", space.region_3d
    overlay = import_module(f"{module}.engine.gpu.overlay")
    (person,) = [layer for layer in bpy.context.view_layer.layer_collection.children if layer.name == "Human"]
    yield from wait(lambda: overlay.overlay.resting and bool(overlay.overlay._regions), 120)
    measured = {True: [], False: []}
    for _ in range(ROUNDS):
        for person.exclude, times in measured.items():
            yield 1.0
            for _ in range(STEPS):
                around.view_rotation = Quaternion((0, 0, 1), TURN) @ around.view_rotation
                times.append(finished_ms(redraw_view))
            if not person.exclude:
                yield "turning_at_once"
    empty, shown = (statistics.median(times) for times in measured.values())
    stops = []
    for _ in range(ROUNDS):
        yield from wait(lambda: overlay.overlay.resting, 60)
        for _ in range(STEPS):
            around.view_rotation = Quaternion((0, 0, 1), TURN) @ around.view_rotation
            began, seen = time.monotonic(), seen_from(overlay)
            yield 0.02
        yield from wait(lambda seen=seen: bool(seen), 60)
        stops.append(seen[0] - began)
        yield 3.0
        yield "turning_after_3_s"
        yield from wait(lambda: overlay.overlay.resting, 120)
        print(f"turning: refined {time.monotonic() - began:.1f} s after the stop", flush=True)
    yield "turning_refined"
    print(f"turning: whole after {stops} s, redraws of {empty:.0f} and {shown:.0f} ms", flush=True)
    figures = {"orbit_empty_ms": empty, "orbit_ratio_1": shown / empty, "coarse_after_stop_seconds": max(stops)}
    yield {"figures": {name: round(value, 3) for name, value in figures.items()}}


def seen_from(overlay) -> list[float]:
    """Gets the time when the next picture of humans is drawn."""
    seen: list[float] = []
    draw = overlay.draw_picture

    def drawn(*given: object) -> None:
        draw(*given)
        finish()
        overlay.draw_picture = draw
        seen.append(time.monotonic())

    overlay.draw_picture = drawn
    return seen


def playing(module: str, python: str) -> Steps:
    """Measures frames of two walking humans, each with its redraw, against those of an empty scene."""
    yield from with_people(module, python, FIRST_SEED, SECOND_SEED)
    for armature in armatures():
        select(armature)
        press("primdiffusion.add_motion", motion="WALK", rounds=3)
        yield 0.5
    wide_view()
    view()[1].spaces.active.shading.type = "SOLID"
    overlay = import_module(f"{module}.engine.gpu.overlay").overlay
    people = [one for one in bpy.context.view_layer.layer_collection.children if one.name.startswith("Human")]
    yield from wait(lambda: overlay.resting and bool(overlay._regions), 120)
    measured: dict[bool, list[float]] = {True: [], False: []}
    for round_ in range(ROUNDS):
        for hidden, times in measured.items():
            for person in people:
                person.exclude = hidden
            yield 1.0
            for step in range(STEPS):
                frame = 2 + round_ * STEPS + step
                times.append(finished_ms(lambda frame=frame: (bpy.context.scene.frame_set(frame), redraw_view())))
    yield "playing_at_once"
    empty, shown = (statistics.median(times) for times in measured.values())
    yield {"figures": {"playback_empty_ms": round(empty, 3), "playback_ratio_2": round(shown / empty, 3)}}
