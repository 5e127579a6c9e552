"""Whether Cycles of this Blender draws volumes: found out once for each build, by a child Blender (`volume_check`)."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
from pathlib import Path

import bpy

from ..backend.child_variables import BLENDER, COMPUTING, passed_on
from ..engine.who_draws import note_volumes
from ..formats.json_files import read_json
from ..places import own_folder

FAULT = (
    "Cycles of this Blender draws volumes empty, a fault of its build (Debian's 5.2 has it): render with "
    "PrimDiffusion, or with a Blender from blender.org"
)
PROGRAM = Path(__file__).resolve().parents[1] / "scene" / "volume_check.py"
DRAWN, EMPTY = "PRIMDIFFUSION DRAWN", "PRIMDIFFUSION EMPTY"
"""What the program prints."""
LONGEST_S = 120.0
_TICK_S = 0.5

_known: dict[str, bool] = {}
"""Whether volumes are empty, by the build; found or read from the file in this session."""
_running: subprocess.Popen[str] | None = None


def volumes_are_empty() -> bool:
    """Whether that is known. Where it is not, a check begins, which a timer follows; never waits. For panels."""
    global _running
    known = _recall()
    if known is None and _running is None:
        _running = _start()
        bpy.app.timers.register(_follow, first_interval=_TICK_S, persistent=True)
    note_volumes("CYCLES", bool(known))
    return bool(known)


def check() -> bool:
    """The same for command lines: waits for the check, a few seconds, where it is not known yet."""
    known = _recall()
    if known is None:
        with _start() as process:
            try:
                known = _result(process.communicate(timeout=LONGEST_S)[0])
            except subprocess.TimeoutExpired:
                process.kill()
                known = False
    return known


def unregister() -> None:
    """End a running check."""
    global _running
    if bpy.app.timers.is_registered(_follow):
        bpy.app.timers.unregister(_follow)
    if _running is not None:
        _running.kill()
        _running.communicate()
        _running = None


def _follow() -> float | None:
    global _running
    if _running is None:
        return None
    if _running.poll() is None:
        return _TICK_S
    _result(_running.communicate()[0])
    _running = None
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()
    return None


def _start() -> subprocess.Popen[str]:
    command = [bpy.app.binary_path, "-b", "--factory-startup", "--python", str(PROGRAM)]
    environment = passed_on(COMPUTING, BLENDER)
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def _result(printed: str) -> bool:
    """Keep the result; a check that failed counts as drawn, and is not kept in the file."""
    empty = EMPTY in printed
    _known[_build()] = empty
    if empty or DRAWN in printed:
        with contextlib.suppress(OSError):
            _file().write_text(json.dumps({_build(): empty}), encoding="utf-8")
    return empty


def _recall() -> bool | None:
    if not bpy.app.binary_path:  # Blender as a module, from PyPI, draws them
        return False
    if _build() not in _known:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            _known[_build()] = bool(read_json(_file())[_build()])
    return _known.get(_build())


def _file() -> Path:
    folder = own_folder()
    folder.mkdir(parents=True, exist_ok=True)
    return folder / "cycles.json"


def _build() -> str:
    return f"{bpy.app.version_string} {os.stat(bpy.app.binary_path).st_mtime_ns}"
