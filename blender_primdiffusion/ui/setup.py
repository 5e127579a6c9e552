"""Set up or repair the backend's private environment, and cancel that; the scene stays as it is.

The viewer build lacks this file.
"""

from __future__ import annotations

import functools
from pathlib import Path

import bpy

from ..backend import setup
from ..backend.environment import state_of
from ..backend.packages import Lock, Machine, chosen_compute, locks_for, read_lock, this_machine
from ..backend.requests import Steps, sentence
from ..engine import drawing_child
from ..jobs.follow import Reporting, StepRunner
from ..jobs.queue import queue
from ..places import EXTENSION, backend_module_path, cache_folder, set_up_folder
from .declared import SKIP
from .drawing import draw_lines

LOCKS = Path(__file__).resolve().parents[1] / "requirements"
_ONLINE = "Blender may not use the network: allow it, or name an existing Python in the preferences."


session = StepRunner(
    "the backend is being set up already", "Cancelled; what has been downloaded is used by the next Set Up Backend"
)
"""One for all windows."""


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


def is_outdated(about: dict) -> bool:
    """Whether the environment with this mark was made of another lock than the extension's of now."""
    path = LOCKS / str(about.get("lock_name", ""))
    return path.is_file() and read_once(path).digest != about.get("lock")


def installing() -> Steps:
    """Steps of a set-up. Raises ValueError where there are no packages for this machine or Blender may not use the
    network, and OSError."""
    compute, lock, _ = chosen()
    if not bpy.app.online_access:
        raise ValueError(setup.OFFLINE)
    module_path = backend_module_path()
    if module_path is None:
        raise ValueError("the extension lacks its backend: install its zip again")
    return setup.set_up(set_up_folder(), lock, compute, module_path, cache_folder())


def draw_progress(layout: bpy.types.UILayout, width: int) -> None:
    """The bar, the current step below it (a bar cuts long texts), and Cancel."""
    layout.progress(factor=session.fraction, text=f"{session.fraction:.0%}")
    draw_lines(layout, session.message, "BLANK1", width)
    layout.operator("primdiffusion.cancel", icon="CANCEL").what = "SET_UP"


def draw_cost(layout: bpy.types.UILayout, width: int) -> bool:
    """The cost of a set-up, and what prevents it; returns whether it is possible on this machine."""
    try:
        _, lock, note = chosen()
    except (ValueError, OSError) as error:
        draw_lines(layout, sentence(error), "ERROR", width)
        return False
    draw_lines(layout, cost(lock), "BLANK1", width)
    if note:
        draw_lines(layout, note, "INFO", width)
    if not bpy.app.online_access:
        draw_lines(layout, _ONLINE, "INTERNET_OFFLINE", width)
        layout.operator("extensions.userpref_allow_online", text="Allow Online Access", icon="CHECKMARK")
    return True


def draw_button(layout: bpy.types.UILayout, width: int, *, broken: bool) -> bool:
    """For a sidebar: the cost and the button; what prevents it, and False, where there are no packages."""
    possible = draw_cost(layout, width)
    if possible:
        text, icon = ("Repair", "TOOL_SETTINGS") if broken else ("Set Up Backend", "IMPORT")
        row = layout.row()
        row.enabled = bpy.app.online_access
        row.operator("primdiffusion.set_up_backend", text=text, icon=icon).repair = broken
    return possible


def draw_private(layout: bpy.types.UILayout, width: int, *, there: bool) -> None:
    """For the preferences: the cost and all buttons; `there`: an environment to repair."""
    possible = draw_cost(layout, width)
    row = layout.row()
    row.enabled = possible and bpy.app.online_access
    row.operator("primdiffusion.set_up_backend", icon="IMPORT")
    if there:
        row.operator("primdiffusion.set_up_backend", text="Repair", icon="TOOL_SETTINGS").repair = True


def draw_result(layout: bpy.types.UILayout, width: int) -> None:
    """How the last set-up ended."""
    if session.error:
        draw_lines(layout, session.error, "ERROR", width)
    elif session.notice:
        draw_lines(layout, session.notice, "INFO", width)


def cost(lock: Lock) -> str:
    """The cost of a set-up, as a sentence."""
    return f"Downloads {gigabytes(lock.download_bytes)}, takes {gigabytes(lock.installed_bytes)} on disk"


def gigabytes(size: float) -> str:
    """Bytes in GB or MB."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"


class PRIMDIFFUSION_OT_set_up_backend(Reporting, bpy.types.Operator):
    """Download the backend's packages into a private environment and test it"""

    bl_idname = "primdiffusion.set_up_backend"
    bl_label = "Set Up Backend"
    described_by = ("repair",)

    repair: bpy.props.BoolProperty(name="Repair", description="Reinstall the backend", options=SKIP)

    def act(self, _context: bpy.types.Context) -> set[str]:
        if session.busy:
            raise ValueError("the backend is being set up already; wait for it, or press Cancel")
        state, about = state_of(set_up_folder())
        if not self.repair and state == "ready" and about.get("compute") == chosen()[0]:
            self.report({"INFO"}, "The backend is set up already: press Repair to reinstall it.")
            return {"FINISHED"}
        steps = installing()
        if queue.busy:
            raise ValueError("the backend is at work; wait until it is done, or press Cancel")
        queue.close()  # children that run on the environment: their files could not be replaced
        drawing_child.close()
        session.start(steps)
        return session.follow(self)


def unregister() -> None:
    """End a running set-up."""
    session.close()
