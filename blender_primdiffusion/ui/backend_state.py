"""The backend as panels and preferences show it: set up by the extension, or installed by the user."""

from __future__ import annotations

from ..places import INSTALLS_BACKEND

if INSTALLS_BACKEND:
    from .setup import operators, preferences
    from .setup.operators import being_set_up, cancel_set_up
    from .setup.preferences import draw_set_up

    MODULES = (operators, preferences)
else:
    from . import connection
    from .connection import being_set_up, cancel_set_up, draw_set_up

    MODULES = (connection,)

__all__ = ["MODULES", "being_set_up", "cancel_set_up", "draw_set_up"]
