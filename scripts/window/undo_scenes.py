"""Undo and redo by key, twenty at a time, while timers change data. Played on request: 100 rounds take an hour.

    ROUNDS=100 python scripts/window/look.py --scenes undo_and_timers
    ROUNDS=50 python scripts/window/look.py --scenes undo_while_generating

The figures of the first are window_rounds, those that went well; window_rounds_among_steps, those of them in which both
the motion and the result were there before the last step; and window_crashes.
"""

from __future__ import annotations

import dataclasses
import os
from importlib import import_module
from pathlib import Path

import bpy
from panels import view
from press import Steps, press, wait
from start import FIRST_SEED, armatures, cancel_all, people_file, queue_of, select, with_people

ROUNDS = int(os.environ.get("ROUNDS", "100"))
KEYS = 20
"""Steps of undo, and then of redo, that wait in Blender's queue at once."""
FRESH_EVERY = 10
"""Rounds after which the file is opened again, so that undo steps take no more memory."""
REST_S = 1.0
"""Without a step for so long, no key is left to handle."""
_MOTIONS = ("WALK", "WAVE")


@dataclasses.dataclass
class Round:
    """When the motion and the result came: steps of undo and redo that Blender had handled by then; -1: not yet."""

    module: str
    number: int
    steps: int = 0
    asked: int = -1
    """The file was imported."""
    ready: int = -1
    """Its human waits to enter the scene."""
    entered: int = -1
    motion: int = -1
    moving: str = ""
    """Name of the armature that got the motion."""

    @property
    def motion_after(self) -> int:
        return 1 + 11 * self.number % (KEYS + KEYS // 2)

    @property
    def import_after(self) -> int:
        """While undo goes on: the motion may leave nothing to redo."""
        return 1 + 7 * self.number % (KEYS - 1)

    @property
    def most_steps(self) -> int:
        """How many of the keys find a step. A motion between two steps leaves nothing to redo but what follows it."""
        return 2 * KEYS - self.motion if self.motion < KEYS else self.motion

    def count(self, *_: object) -> None:
        """Handler of undo_post and redo_post."""
        self.look()
        self.steps += 1
        if self.steps == self.motion_after:
            bpy.app.timers.register(self._add_motion)
        if self.steps == self.import_after:
            bpy.app.timers.register(self._import)

    def look(self) -> bool:
        """Note what has come; whether all has."""
        queue = queue_of(self.module)
        if self.ready < 0 and queue.ready:
            self.ready = self.steps
        if self.entered < 0 <= self.asked and not queue.busy:
            self.entered = self.steps
        return min(self.entered, self.motion) >= 0

    def _add_motion(self) -> None:
        """As a script of the user would, with an undo step."""
        _do("primdiffusion.add_motion", motion=_MOTIONS[self.number % len(_MOTIONS)])
        self.moving = bpy.context.view_layer.objects.active.name
        self.motion = self.steps

    def _import(self) -> None:
        """Ask for a human, which changes nothing yet."""
        file = import_module(f"{self.module}.scene.human").session_file(armatures()[0])
        press("primdiffusion.import_human", "EXEC_DEFAULT", filepath=str(file))
        self.asked = self.steps


def undo_and_timers(module: str, python: str) -> Steps:
    """In each round a result of the queue and a timer's motion arrive among forty queued steps of undo and redo.

    Blender 5.2.2 crashes when the timer's motion is no undo step. Fails where a human or the motion is lost, where
    data are not whole, and where a step of undo comes between the result and the keys that follow it.
    """
    yield from with_people(module, python, FIRST_SEED)
    path, among = str(people_file(module)), 0
    for number in range(ROUNDS):
        if number % FRESH_EVERY == 0:
            bpy.ops.wm.open_mainfile(filepath=path, load_ui=False)
            yield 1.0
            select(armatures()[0])
        this = Round(module, number)
        handlers = (bpy.app.handlers.undo_post, bpy.app.handlers.redo_post)
        for handler in handlers:
            handler.append(this.count)
        try:
            yield from _play(this)
        finally:
            for handler in handlers:
                handler.remove(this.count)
        among += this.ready < this.steps and this.motion < this.steps
        print(this, flush=True)
        yield {"figures": {"window_rounds": number + 1, "window_rounds_among_steps": among}}


def undo_while_generating(module: str, python: str) -> Steps:
    """Shift-D, Alt-D, Delete, IK handles and an imported BVH file, undone and redone while variations are generated.

    The figures are window_generating_rounds and window_keys_while_generating: steps that Blender had handled by then.
    """
    yield from with_people(module, python, FIRST_SEED)
    path, bvh = str(people_file(module)), str(Path(bpy.app.tempdir) / "walk.bvh")
    _do("primdiffusion.add_motion", motion="WALK")
    _do("export_anim.bvh", filepath=bvh, frame_start=1, frame_end=20)
    queue, total = queue_of(module), 0
    for number in range(ROUNDS):
        if number % FRESH_EVERY == 0:
            bpy.ops.wm.open_mainfile(filepath=path, load_ui=False)
            yield 1.0
            bpy.context.scene.primdiffusion_variations.count = "4"
            bpy.context.scene.primdiffusion.quality = "DRAFT"
        select(armatures()[0])
        this, name = Round(module, number), armatures()[0].name
        yield {"point": _middle_of_the_view()}
        for key in ("shift+d", "alt+d"):  # both are dragged until confirmed
            yield {"key": key}
            yield 0.5
            yield {"key": "Return"}
            yield 0.5
        yield {"key": "Delete"}
        yield 0.5
        _check(this, 2)
        press("primdiffusion.variations")
        yield from wait(lambda: queue.request is not None and queue.request.step > 0, 120)
        _do("primdiffusion.import_motion", human=name, filepath=bvh)
        _do("primdiffusion.add_handles", human=name)
        counted = [0, 0]

        def count(*_: object, counted: list[int] = counted) -> None:
            counted[queue.busy] += 1

        handlers = (bpy.app.handlers.undo_post, bpy.app.handlers.redo_post)
        for handler in handlers:
            handler.append(count)
        try:
            for keys in ("ctrl+z", "ctrl+shift+z", "ctrl+z", "ctrl+shift+z"):
                yield {"key": keys, "times": KEYS}
                yield REST_S
            before = -1
            while sum(counted) != before:
                before = sum(counted)
                yield REST_S
        finally:
            for handler in handlers:
                handler.remove(count)
        total += counted[True]
        print(f"round {number}: {counted[True]} steps while generating, {counted[False]} after it", flush=True)
        _check(this, 2)
        if number % FRESH_EVERY == 0:
            yield f"undo_while_generating_{number:02}"
        if number % 2:
            yield from cancel_all(module)
        else:
            yield from wait(lambda: not queue.busy, 300)
        yield {"key": "ctrl+z", "times": KEYS}
        yield REST_S
        _check(this)
        yield {"figures": {"window_generating_rounds": number + 1, "window_keys_while_generating": total}}


def _do(operator: str, **given: object) -> None:
    """An operator with its undo step, as a button does it."""
    window, area = view()
    region = next(region for region in area.regions if region.type == "WINDOW")
    room, name = operator.split(".")
    with bpy.context.temp_override(window=window, area=area, region=region):
        getattr(getattr(bpy.ops, room), name)("EXEC_DEFAULT", True, **given)


def _play(this: Round) -> Steps:
    before = _people(this)
    _push_steps(KEYS)
    yield {"point": _middle_of_the_view()}
    yield {"key": "ctrl+z", "times": KEYS}
    yield {"key": "ctrl+shift+z", "times": KEYS}
    yield from wait(this.look, 300)
    if not this.look():
        yield "undo_and_timers_waiting"
        blocker = import_module(f"{this.module}.jobs.windows").blocking_activity() or "nothing"
        raise RuntimeError(f"{this}: not there within five minutes; in the way: {blocker}")
    yield from _rest(this)
    handled = this.steps
    if 0 < this.entered < handled:
        raise RuntimeError(f"{this}: undo went on after the result had entered")
    _check(this, before + 1)
    if handled == this.most_steps:
        _check_motion(this)
    if this.number % FRESH_EVERY == 0:
        yield f"undo_and_timers_{this.number:02}"
    for key, people in (("ctrl+z", before), ("ctrl+shift+z", before + 1)):
        yield {"key": key}
        yield from _rest(this)
        _check(this, people)
    yield {"key": "ctrl+z", "times": KEYS}
    yield from _rest(this)
    _check(this)
    this.steps = handled


def _push_steps(count: int) -> None:
    """Undo steps that change data which nothing else does."""
    for number in range(count):
        bpy.context.scene.cursor.location.x = 0.01 * number
        bpy.ops.ed.undo_push(message=f"Step {number}")


def _rest(this: Round) -> Steps:
    """Wait until the keys that were pressed are handled."""
    before = -1
    while this.steps != before:
        before = this.steps
        yield REST_S


def _middle_of_the_view() -> list[int]:
    window, area = view()
    return [area.x + area.width // 2, window.height - area.y - area.height // 2]


def _people(this: Round) -> int:
    return len(import_module(f"{this.module}.scene.human").humans(bpy.context.scene))


def _check(this: Round, expected: int | None = None) -> None:
    """Read all that humans consist of; RuntimeError where something is missing, or their number is not as expected."""
    found = _people(this)
    if not found or len(armatures()) < found or found != (expected or found):
        raise RuntimeError(f"{this}: {found} humans, {len(armatures())} armatures; expected {expected or 'some'}")
    for armature in armatures():
        animation = armature.animation_data
        if animation is not None and animation.action is not None:
            bags = [bag for layer in animation.action.layers for strip in layer.strips for bag in strip.channelbags]
            curves = [curve for bag in bags for curve in bag.fcurves]
            if not curves or not all(len(curve.keyframe_points) for curve in curves):
                raise RuntimeError(f"{this}: the motion of {armature.name!r} is empty")
    bpy.context.view_layer.update()


def _check_motion(this: Round) -> None:
    """After keys that have all found a step, the motion is there again."""
    animation = bpy.data.objects[this.moving].animation_data
    if animation is None or animation.action is None:
        raise RuntimeError(f"{this}: the motion of {this.moving!r} is lost")
