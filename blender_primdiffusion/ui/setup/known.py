"""What is known of the backend without starting it, fast enough for drawing; and the cost of a set-up."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import os
from pathlib import Path
from typing import Any, Literal

import bpy

from ...backend.environment import NOT_ABSOLUTE, VARIABLE, tried
from ...backend.packages import Lock, Machine, chosen_compute, locks_for, read_lock, this_machine
from ...backend.requests import sentence
from ...backend.setup import state_of
from ...formats.regular_files import is_local_path
from ...places import EXTENSION, preference, set_up_folder

LOCKS = Path(__file__).resolve().parents[2] / "requirements"
_LINE_BYTES_PER_S = 50e6 / 8
"""Of the network, for the estimate: 50 Mbit/s."""
_UNPACKED_BYTES_PER_S = 30e6
_SELF_TEST_S = 30.0


@dataclasses.dataclass(frozen=True)
class Known:
    """Which Python would run the backend."""

    state: Literal["named", "own Python", "ready", "outdated", "broken", "absent"]
    usable: bool
    line: str
    """For the panels."""
    about: dict[str, Any] = dataclasses.field(default_factory=dict)
    """What the environment's mark says."""
    works: bool | None = None
    """Whether it imported torch and the backend; None until it was tried."""


def known() -> Known:
    """Which Python would run the backend, in the order in which it is searched."""
    if named := preference("backend_python"):
        if not is_local_path(named):
            return Known("named", False, sentence(NOT_ABSOLUTE.format("a Python", named[:200])))
        return Known("named", True, f"Uses {named}", works=tried.get(Path(named)))
    if named := os.environ.get(VARIABLE):
        line = f"Uses {named}, named by the environment variable {VARIABLE}"
        return Known("named", True, line, works=tried.get(Path(named)))
    state, about = state_of(set_up_folder())
    if state == "ready":
        versions = f"torch {about.get('torch')}, Python {about.get('python')}"
        line, works = f"Ready: {versions}, {about.get('device') or 'CPU'}", tried.get(set_up_folder().python, True)
        if _made_of_another_lock(about):
            return Known(
                "outdated", True, f"{line}. Made for another version of the extension: press Repair", about, works
            )
        return Known("ready", True, line, about, works)
    if _has_torch():
        return Known("own Python", True, "Uses Blender's own Python, which has torch", works=True)
    if state == "broken":
        return Known("broken", False, "Half installed, or made by a Blender that is gone: press Repair", about)
    return Known("absent", False, "The backend is not set up yet")


@functools.cache
def _has_torch() -> bool:
    """Whether Blender's own Python has torch, as in an environment with Blender as a module."""
    return importlib.util.find_spec("torch") is not None


def _made_of_another_lock(about: dict[str, Any]) -> bool:
    path = LOCKS / str(about.get("lock_name", ""))
    return path.is_file() and read_once(path).digest != about.get("lock")


@functools.cache
def machine() -> Machine:
    """The machine we run on."""
    return this_machine()


@functools.lru_cache(maxsize=16)
def read_once(path: Path) -> Lock:
    """The lock in a file. Raises OSError, ValueError."""
    return read_lock(path)


@functools.cache
def available() -> dict[str, Path]:
    """The locks for this machine, by device."""
    return locks_for(LOCKS, machine().platform, machine().python)


def chosen() -> tuple[str, Lock, str]:
    """What would be set up: the device, its packages, and a note or "".

    Raises ValueError in a sentence.
    """
    addon = bpy.context.preferences.addons.get(EXTENSION)
    wish = addon.preferences.compute.lower() if addon is not None else "automatic"
    compute, note = chosen_compute(machine(), wish, available())
    return compute, read_once(available()[compute]), note


def cost(lock: Lock) -> str:
    """The cost of a set-up, as a sentence."""
    seconds = lock.download_bytes / _LINE_BYTES_PER_S + lock.installed_bytes / _UNPACKED_BYTES_PER_S + _SELF_TEST_S
    return (
        f"Downloads {gigabytes(lock.download_bytes)}, takes {gigabytes(lock.installed_bytes)} on disk, "
        f"about {max(round(seconds / 60), 1)} min at 50 Mbit/s"
    )


def gigabytes(size: float) -> str:
    """Bytes in GB or MB."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"
