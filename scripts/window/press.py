"""Presses buttons, and waits for their results."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
from panels import view

Steps = Iterator[float | str | dict]


def press(operator: str, how: str = "INVOKE_DEFAULT", **given: object) -> set[str]:
    """Invoke an operator in the 3D view, as a click on its button does; like a button, it may be rejected by `poll`."""
    window, area = view()
    region = next(region for region in area.regions if region.type == "WINDOW")
    room, name = operator.split(".")
    with bpy.context.temp_override(window=window, area=area, region=region):
        try:
            return getattr(getattr(bpy.ops, room), name)(how, **given)
        except RuntimeError as error:
            print(f"{operator}: {error}", flush=True)
            return {"CANCELLED"}


def pose(armature: bpy.types.Object, name: str) -> None:
    """Apply a pose of the extension's asset library, as a click in the asset shelf does."""
    library = bpy.context.preferences.filepaths.asset_libraries["PrimDiffusion"]
    with bpy.data.libraries.load(str(Path(library.path) / "poses.blend")) as (_, wanted):
        wanted.actions = [name]
    armature.pose.apply_pose_from_action(wanted.actions[0])


def invoke(operator: str, **given: object) -> set[str]:
    """The same, for operators that open a dialog."""
    return press(operator, "INVOKE_DEFAULT", **given)


def wait(over: Callable[[], bool], most_s: float) -> Steps:
    began = time.monotonic()
    while not over() and time.monotonic() - began < most_s:
        yield 0.1
