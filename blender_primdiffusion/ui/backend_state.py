"""The backend as panels and preferences show it: set up by the extension, or installed by the user."""

from __future__ import annotations

from ..places import INSTALLS_BACKEND

if INSTALLS_BACKEND:
    from .setup import operators, preferences
    from .setup.preferences import draw_set_up

    MODULES = (operators, preferences)
else:
    from . import connection
    from .connection import draw_set_up

    MODULES = (connection,)

__all__ = ["MODULES", "draw_set_up"]
