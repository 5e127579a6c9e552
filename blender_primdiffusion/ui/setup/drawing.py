"""How the backend's state looks, in the preferences and wherever it is missing."""

from __future__ import annotations

import textwrap

import bpy

from ...places import EXTENSION
from ...worker.sentence import sentence
from .known import chosen, cost, known
from .session import session

_SIDEBAR = 30
"""Characters that fit a box in a sidebar as wide as Blender makes it, beside an icon."""
ONLINE = "Blender may not use the network: allow it in System > Network > Allow Online Access, or install from a folder"


def draw_set_up(layout: bpy.types.UILayout, width: int = _SIDEBAR) -> bool:
    """In a panel that needs the backend: progress while it is set up, or the button when it is not.

    Draws nothing where a backend is there. Returns whether there is one.
    """
    if session.busy:
        draw_progress(layout, width)
        return False
    now = known()
    if now.usable:
        return True
    box = layout.box()
    draw_text(box, now.line, "ERROR", width)
    if not draw_cost(box, width):
        props = box.operator("preferences.addon_show", text="Open Preferences", icon="PREFERENCES")
        props.module = EXTENSION
    elif now.state == "broken":
        box.operator("primdiffusion.repair_backend", icon="TOOL_SETTINGS")
    else:
        box.operator("primdiffusion.set_up_backend", icon="IMPORT")
    draw_news(box, width)
    return False


def draw_progress(layout: bpy.types.UILayout, width: int) -> None:
    """The bar, what is being done, and Cancel. A bar cuts words that are too long for it."""
    layout.progress(factor=session.fraction, text=f"{session.fraction:.0%}")
    draw_text(layout, session.message, "BLANK1", width)
    layout.operator("primdiffusion.cancel_set_up", icon="CANCEL")


def draw_cost(layout: bpy.types.UILayout, width: int) -> bool:
    """What pressing the button takes, and what stands in its way; whether there is anything to set up here."""
    try:
        _, lock, note = chosen()
    except (ValueError, OSError) as error:
        draw_text(layout, sentence(error), "ERROR", width)
        return False
    draw_text(layout, cost(lock), "BLANK1", width)
    if note:
        draw_text(layout, note, "INFO", width)
    if not bpy.app.online_access:
        draw_text(layout, ONLINE, "INTERNET_OFFLINE", width)
    return True


def draw_news(layout: bpy.types.UILayout, width: int) -> None:
    """How the last one ended."""
    if session.error:
        draw_text(layout, session.error, "ERROR", width)
    elif session.notice:
        draw_text(layout, session.notice, "INFO", width)


def draw_text(layout: bpy.types.UILayout, text: str, icon: str, width: int) -> None:
    """A sentence over as many lines as it needs."""
    column = layout.column(align=True)
    for number, line in enumerate(textwrap.wrap(text, width)):
        column.label(text=line, icon=icon if number == 0 else "BLANK1", translate=False)
