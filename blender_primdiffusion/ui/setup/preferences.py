"""Preferences; and the state of the backend, drawn here and in panels that need it."""

from __future__ import annotations

import bpy

from ...backend.requests import sentence
from ...places import EXTENSION, set_up_folder
from ..drawing import draw_lines
from ..preferences import WIDTH, CommonPreferences, forget_failures
from .known import Known, chosen, cost, gigabytes, known, machine
from .operators import redraw, session

_SIDEBAR = 30
"""Characters that fit a box in a sidebar of default width, beside an icon."""
ONLINE = "Blender may not use the network: allow it in System > Network > Allow Online Access, or install from a folder"


def draw_set_up(layout: bpy.types.UILayout) -> bool:
    """For panels that need the backend: the progress of a set-up, or its button; nothing where a backend is ready.

    Returns whether it is.
    """
    if session.busy:
        draw_progress(layout, _SIDEBAR)
        return False
    now = known()
    if now.usable:
        return True
    box = layout.box()
    draw_lines(box, now.line, "ERROR", _SIDEBAR)
    if now.state == "named" or not draw_cost(box, _SIDEBAR):
        props = box.operator("preferences.addon_show", text="Open Preferences", icon="PREFERENCES")
        props.module = EXTENSION
    elif now.state == "broken":
        box.operator("primdiffusion.set_up_backend", text="Repair", icon="TOOL_SETTINGS").repair = True
    else:
        box.operator("primdiffusion.set_up_backend", icon="IMPORT")
    draw_result(box, _SIDEBAR)
    return False


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
        draw_lines(layout, ONLINE, "INTERNET_OFFLINE", width)
    return True


def draw_result(layout: bpy.types.UILayout, width: int) -> None:
    """How the last set-up ended."""
    if session.error:
        draw_lines(layout, session.error, "ERROR", width)
    elif session.notice:
        draw_lines(layout, session.notice, "INFO", width)


_COMPUTE = (
    ("AUTOMATIC", "Automatic", "NVIDIA where there is a driver that is new enough, else the processor"),
    ("CPU", "CPU", "Smallest download; a human takes seconds instead of fractions of one"),
    ("CUDA", "NVIDIA (CUDA)", "Large download; needs an NVIDIA card and driver"),
    ("APPLE", "Apple", "For Apple Silicon; computes on its processor"),
)


def _python_changed(_preferences: bpy.types.AddonPreferences, _context: bpy.types.Context) -> None:
    """What the former Python did is of no interest any more."""
    session.error = session.notice = ""
    forget_failures()
    redraw()


class PRIMDIFFUSION_AP_preferences(CommonPreferences, bpy.types.AddonPreferences):
    """Shown in Edit > Preferences > Add-ons > PrimDiffusion."""

    compute: bpy.props.EnumProperty(
        name="Compute On", description="Device that packages are installed for", items=_COMPUTE
    )
    backend_python: bpy.props.StringProperty(
        name="Existing Python",
        description="Python 3.11 or newer with PrimDiffusion's packages (torch), used instead of the private "
        "environment; empty: the private environment",
        subtype="FILE_PATH",
        update=_python_changed,
    )

    def draw(self, _context: bpy.types.Context) -> None:
        layout = self.layout
        self._draw_backend(layout.box())
        self.draw_properties(layout)

    def _draw_backend(self, box: bpy.types.UILayout) -> None:
        if session.busy:
            draw_progress(box, WIDTH)
            return
        now, folder = known(), set_up_folder()
        draw_lines(box, now.line, _icon(now), WIDTH)
        if now.usable and now.works is None:
            draw_lines(box, "Not tested yet: press Test", "BLANK1", WIDTH)
        if folder.environment.is_dir():
            size = f"{gigabytes(now.about['bytes'])} in " if "bytes" in now.about else ""
            draw_lines(box, f"{size}{folder.environment}", "FILE_FOLDER", WIDTH)
        if now.state != "named":
            _draw_private(self, box)
        self._draw_buttons(box, now.state, folder.environment.is_dir())
        draw_result(box, WIDTH)
        if session.error and folder.log.is_file():
            box.operator("wm.path_open", text="Open Log", icon="TEXT").filepath = str(folder.log)

    def _draw_buttons(self, box: bpy.types.UILayout, state: str, private: bool) -> None:
        row = box.row()
        row.operator("primdiffusion.test_backend", icon="PLAY")
        if private or state not in {"absent", "own Python", "named"}:
            row.operator("primdiffusion.set_up_backend", text="Repair", icon="TOOL_SETTINGS").repair = True
            row.operator("primdiffusion.remove_backend", icon="TRASH")


def _icon(now: Known) -> str:
    if not now.usable or now.works is False:
        return "ERROR"
    return "QUESTION" if now.works is None else "CHECKMARK"


def _draw_private(preferences: PRIMDIFFUSION_AP_preferences, box: bpy.types.UILayout) -> None:
    """The private environment: device, cost, buttons."""
    row = box.row()
    row.prop(preferences, "compute", expand=True)
    draw_lines(box, f"Found: {machine().described}", "SYSTEM", WIDTH)
    here = draw_cost(box, WIDTH)
    row = box.row()
    row.enabled = here
    row.operator("primdiffusion.set_up_backend", icon="IMPORT")
    row.operator("primdiffusion.set_up_backend", text="Install from Folder", icon="FILE_FOLDER").choose = True
