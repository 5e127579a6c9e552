"""The backend of the viewer build, which sets up none: the user installs it and names it in the preferences."""

from __future__ import annotations

import bpy

from ..backend.environment import NOT_INSTALLED, BackendNotFound, candidates, own_python_has_backend
from ..backend.requests import sentence
from ..places import EXTENSION, installed_backend, preference
from .drawing import draw_lines
from .preferences import NOTHING_TO_CANCEL, WIDTH, CommonPreferences, forget_failures

_SIDEBAR = 30
"""Characters that fit a box in a sidebar of default width, beside an icon."""


def found() -> tuple[bool, str]:
    """Whether there is a backend to try, without trying it; and which, or what to do, for panels."""
    own = own_python_has_backend()
    try:
        named = next(candidates(preference("backend_python"), None, installed_backend(), own_python=own), None)
    except BackendNotFound as error:
        return False, sentence(error)
    return (False, sentence(NOT_INSTALLED)) if named is None else (True, f"Uses {named[1]}, named by {named[0]}")


def draw_set_up(layout: bpy.types.UILayout) -> bool:
    """For panels that need the backend: what to do where there is none. Returns whether there is one."""
    usable, line = found()
    if not usable:
        box = layout.box()
        draw_lines(box, line, "ERROR", _SIDEBAR)
        box.operator("preferences.addon_show", text="Open Preferences", icon="PREFERENCES").module = EXTENSION
    return usable


def being_set_up() -> bool:
    """Whether the backend is being set up: this build sets up none."""
    return False


def cancel_set_up() -> None:
    """Raises ValueError: there is nothing to stop."""
    raise ValueError(NOTHING_TO_CANCEL)


def _backend_changed(_preferences: bpy.types.AddonPreferences, _context: bpy.types.Context) -> None:
    forget_failures()


class PRIMDIFFUSION_AP_preferences(CommonPreferences, bpy.types.AddonPreferences):
    """Shown in Edit > Preferences > Add-ons > PrimDiffusion Viewer."""

    backend_python: bpy.props.StringProperty(
        name="Backend",
        description="The program primdiffusion, or the Python that it is installed in; empty: the program on the PATH",
        subtype="FILE_PATH",
        update=_backend_changed,
    )

    def draw(self, _context: bpy.types.Context) -> None:
        usable, line = found()
        draw_lines(self.layout.box(), line, "CHECKMARK" if usable else "ERROR", WIDTH)
        self.draw_properties(self.layout)
