"""Missing files of humans, looked up after loading, saving and undo, and by a slow timer."""

from __future__ import annotations

import dataclasses

import bpy
from bpy.app.handlers import persistent

from ..scene import collect
from ..scene.human import PERSON_FILE, any_humans
from ..scene.missing import missing_files
from .windows import redraw

SOON_S = 0.5
OFTEN_S = 15.0


@dataclasses.dataclass
class State:
    """What the last look found."""

    summary: str = ""
    """For instance: person.human.safetensors of 'Human'; empty when nothing is missing."""
    without_person_file: tuple[str, ...] = ()
    """Names of humans that have lost their own file."""


state = State()


def look() -> None:
    """Look now."""
    before = state.summary
    state.summary, state.without_person_file = _found() if any_humans() else ("", ())
    if state.summary != before:
        redraw()


def _found() -> tuple[str, tuple[str, ...]]:
    lost = missing_files()
    alone = [one.person.name for one in lost if one.file == PERSON_FILE and not one.linked]
    return "; ".join(one.summary() for one in lost), tuple(alone)


@persistent
def look_after(*_: object) -> None:
    """Handler of load_post and save_post."""
    look()


@persistent
def look_soon(*_: object) -> None:
    """Handler of undo_post and redo_post, several of which may follow each other quickly."""
    if bpy.app.background:
        look()
    else:
        start()


def start() -> None:
    """Have Blender call `look` soon, and then every OFTEN_S."""
    if bpy.app.background:
        return
    stop()
    bpy.app.timers.register(_tick, first_interval=SOON_S, persistent=True)


def stop() -> None:
    """Undo `start`."""
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)


def _tick() -> float:
    look()
    return OFTEN_S


@persistent
def collect_before_saving(blend_path: str, *_: object) -> None:
    """Handler of save_pre."""
    if any_humans():
        collect.collect_before_saving(blend_path)


@persistent
def finish_saving(blend_path: str, *_: object) -> None:
    """Handler of save_post."""
    if any_humans():
        collect.finish_saving(blend_path)


@persistent
def give_up_saving(*_: object) -> None:
    """Handler of save_post_fail."""
    if any_humans():
        collect.give_up_saving()


HANDLERS = (
    ("save_pre", collect_before_saving),
    ("save_post", finish_saving),
    ("save_post_fail", give_up_saving),
    ("load_post", look_after),
    ("save_post", look_after),
    ("undo_post", look_soon),
    ("redo_post", look_soon),
)


def register() -> None:
    """Start the timer."""
    start()


def unregister() -> None:
    """Undo `register`."""
    stop()
