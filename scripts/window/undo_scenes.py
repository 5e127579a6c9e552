"""Undo and redo by key, twenty at a time, while timers change data. Played on request: 100 rounds take half an hour.

    ROUNDS=100 python scripts/window/look.py --scenes undo_and_timers

The figures are window_rounds, those that went well, and window_crashes.
"""

from __future__ import annotations

import os
import time
from importlib import import_module

import bpy
from panels import view
from press import Steps, press, wait
from start import FIRST_SEED, armatures, people_file, queue_of, select, with_people

ROUNDS = int(os.environ.get("ROUNDS", "100"))
KEYS = 20
"""Steps of undo, and then of redo, that wait in Blender's queue at once."""
FRESH_EVERY = 10
"""Rounds after which the file is opened again, so that undo steps take no more memory."""
_MOTIONS = ("WALK", "WAVE")


def undo_and_timers(module: str, python: str) -> Steps:
    """In each round a result of the queue and a timer's motion arrive among forty queued steps of undo and redo.

    Blender 5.2.2 crashes when the timer's motion is no undo step. Fails where the data are not whole afterwards.
    """
    yield from with_people(module, python, FIRST_SEED)
    human = import_module(f"{module}.scene.human")
    path = str(people_file(module))
    for number in range(ROUNDS):
        if number % FRESH_EVERY == 0:
            bpy.ops.wm.open_mainfile(filepath=path, load_ui=False)
            yield 1.0
            select(armatures()[0])
        person = human.humans(bpy.context.scene)[0]
        press("primdiffusion.import_human", "EXEC_DEFAULT", filepath=str(human.person_file(person)))
        _steps(KEYS)
        added = _motion_from_a_timer(_MOTIONS[number % 2], 0.05 * (number % FRESH_EVERY))
        yield {"point": _middle_of_the_view()}
        yield {"key": "ctrl+z", "times": KEYS}
        yield {"key": "ctrl+shift+z", "times": KEYS}
        yield from wait(lambda: not queue_of(module).busy and bool(added), 300)  # noqa: B023 - used in this round alone
        if queue_of(module).busy or not added:
            yield "undo_and_timers_waiting"
            blocker = import_module(f"{module}.jobs.windows").in_the_way() or "nothing"
            states = f"result: {not queue_of(module).busy}, motion: {bool(added)}, in the way: {blocker}"
            raise RuntimeError(f"round {number}: not there within five minutes ({states})")
        _check(module, number)
        yield {"key": "ctrl+z", "times": KEYS}
        yield 0.5
        _check(module, number)
        yield {"figures": {"window_rounds": number + 1}}


def _steps(count: int) -> None:
    """Undo steps that change data which nothing else does."""
    for number in range(count):
        bpy.context.scene.cursor.location.x = 0.01 * number
        bpy.ops.ed.undo_push(message=f"Step {number}")


def _motion_from_a_timer(motion: str, seconds: float) -> list[float]:
    """Have a timer add a motion as a script of the user would, with an undo step; the list gets its time."""
    done: list[float] = []

    def add() -> None:
        window, area = view()
        region = next(region for region in area.regions if region.type == "WINDOW")
        with bpy.context.temp_override(window=window, area=area, region=region):
            bpy.ops.primdiffusion.add_motion("EXEC_DEFAULT", True, motion=motion)
        done.append(time.monotonic())

    bpy.app.timers.register(add, first_interval=seconds)
    return done


def _middle_of_the_view() -> list[int]:
    window, area = view()
    return [area.x + area.width // 2, window.height - area.y - area.height // 2]


def _check(module: str, number: int) -> None:
    """Read all that a human consists of; RuntimeError where something is missing."""
    human = import_module(f"{module}.scene.human")
    people = human.humans(bpy.context.scene)
    if not people or len(armatures()) < len(people):
        raise RuntimeError(f"round {number}: {len(people)} humans, {len(armatures())} armatures")
    for armature in armatures():
        animation = armature.animation_data
        if animation is not None and animation.action is not None:
            bags = [bag for layer in animation.action.layers for strip in layer.strips for bag in strip.channelbags]
            curves = [curve for bag in bags for curve in bag.fcurves]
            if not curves or not all(len(curve.keyframe_points) for curve in curves):
                raise RuntimeError(f"round {number}: the motion of {armature.name!r} is empty")
    bpy.context.view_layer.update()
