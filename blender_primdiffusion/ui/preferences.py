"""The preferences; and the backend as panels show it, set up by the extension or installed by the user."""

from __future__ import annotations

import dataclasses
from typing import Literal

import bpy

from ..backend.environment import NOT_INSTALLED, BackendNotFound, candidates, own_python_has_backend, state_of
from ..backend.requests import sentence
from ..jobs.follow import redraw
from ..places import EXTENSION, INSTALLS_BACKEND, installed_backend, preference, set_up_folder
from .drawing import draw_lines

if INSTALLS_BACKEND:
    from . import setup
else:
    setup = None

_WINDOW, _SIDEBAR = 90, 30
"""Characters in a line of the preferences window, and of a box in a sidebar beside an icon, at their default sizes."""
_COMPUTE = (
    ("AUTOMATIC", "Automatic", "NVIDIA where there is a driver that is new enough, else the processor"),
    ("CPU", "CPU", "Smallest download; a human takes seconds instead of fractions of one"),
    ("CUDA", "NVIDIA (CUDA)", "Large download; needs an NVIDIA card and driver"),
    ("APPLE", "Apple", "For Apple Silicon; computes on its processor"),
)


@dataclasses.dataclass(frozen=True)
class Known:
    """Which Python would run the backend."""

    state: Literal["named", "own Python", "ready", "outdated", "broken", "absent", "wrong"]
    line: str
    """For the panels."""
    size: int = 0
    """Bytes of the private environment."""

    @property
    def usable(self) -> bool:
        """Whether there is a Python to try."""
        return self.state in {"named", "own Python", "ready", "outdated"}


def known() -> Known:
    """Which Python would run the backend, in the order in which it is searched; fast enough for drawing."""
    folder = set_up_folder()
    state, about = state_of(folder) if setup else ("absent", {})
    own = folder.environment if state == "ready" else None
    try:
        named = candidates(preference("backend_python"), own, installed_backend(), own_python=False)
        source, python = next(named, ("", None))
    except BackendNotFound as error:
        return Known("wrong", sentence(error))
    if python is not None and python != folder.python:
        return Known("named", f"Uses {python}, named by {source}")
    if python is not None:
        line = f"Ready: torch {about.get('torch')}, Python {about.get('python')}, {about.get('device') or 'CPU'}"
        size = about.get("bytes", 0)
        if setup.is_outdated(about):
            return Known("outdated", f"{line}. Made for another version of the extension: press Repair.", size)
        return Known("ready", line, size)
    if own_python_has_backend(bundled=setup is not None):
        return Known("own Python", "Uses Blender's own Python, which has torch.")
    if state == "broken":
        return Known("broken", "Half installed, or made by a Blender that is gone: press Repair.")
    return Known("absent", "The backend is not set up yet." if setup else sentence(NOT_INSTALLED))


def draw_set_up(layout: bpy.types.UILayout) -> bool:
    """For panels that need the backend: the progress of a set-up, or what to do; nothing where a backend is ready.

    Returns whether it is.
    """
    if being_set_up():
        setup.draw_progress(layout, _SIDEBAR)
        return False
    now = known()
    if now.usable:
        return True
    box = layout.box()
    draw_lines(box, now.line, "ERROR", _SIDEBAR)
    if setup is None or now.state == "wrong" or not setup.draw_button(box, _SIDEBAR, broken=now.state == "broken"):
        box.operator("preferences.addon_show", text="Open Preferences", icon="PREFERENCES").module = EXTENSION
    if setup:
        setup.draw_result(box, _SIDEBAR)
    return False


def being_set_up() -> bool:
    """Whether the backend is being set up; the viewer build never does that."""
    return setup is not None and setup.session.busy


def cancel_set_up() -> None:
    """Stop the set-up. Raises ValueError where there is none."""
    if not being_set_up():
        raise ValueError("nothing is being set up")
    setup.session.cancel()
    redraw()


def _changed(_preferences: bpy.types.AddonPreferences, _context: bpy.types.Context) -> None:
    redraw()


class PRIMDIFFUSION_AP_preferences(bpy.types.AddonPreferences):
    """Shown in Edit > Preferences > Add-ons > PrimDiffusion."""

    bl_idname = EXTENSION

    compute: bpy.props.EnumProperty(
        name="Compute On", description="Device that packages are installed for", items=_COMPUTE
    )
    backend_python: bpy.props.StringProperty(
        name="Existing Python",
        description="Python 3.11 or newer with PrimDiffusion's packages (torch), or the program primdiffusion; empty: "
        + ("the private environment" if setup else "the program on the PATH"),
        subtype="FILE_PATH",
        update=_changed,
    )
    checkpoint: bpy.props.StringProperty(
        name="Checkpoint",
        description="Diffusion model, a .safetensors file; empty: the bundled one",
        subtype="FILE_PATH",
    )
    captures: bpy.props.BoolProperty(
        name="Captures",
        description="Show the panel Captures in the sidebar: training data from scans",
        update=_changed,
    )

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        _draw_backend(self, layout.box())
        layout.use_property_split = True
        layout.use_property_decorate = False
        for name in ("backend_python", "checkpoint", "captures"):
            layout.prop(self, name)


def _icon(now: Known) -> str:
    if not now.usable:
        return "ERROR"
    return "FILE_SCRIPT" if now.state == "named" else "CHECKMARK"  # what others have made is tried by the first job


def _draw_backend(preferences: PRIMDIFFUSION_AP_preferences, box: bpy.types.UILayout) -> None:
    if being_set_up():
        setup.draw_progress(box, _WINDOW)
        return
    now = known()
    draw_lines(box, now.line, _icon(now), _WINDOW)
    if setup is None:
        return
    folder = set_up_folder()
    if folder.environment.is_dir():
        size = f"{setup.gigabytes(now.size)} in " if now.size else ""
        draw_lines(box, f"{size}{folder.environment}", "FILE_FOLDER", _WINDOW)
    if now.state not in {"named", "wrong"}:
        box.row().prop(preferences, "compute", expand=True)
        setup.draw_private(box, _WINDOW, there=folder.environment.is_dir())
    setup.draw_result(box, _WINDOW)
    if setup.session.error and folder.log.is_file():
        box.operator("wm.path_open", text="Open Log", icon="TEXT").filepath = str(folder.log)
