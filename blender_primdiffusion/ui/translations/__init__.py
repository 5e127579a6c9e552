"""The interface in German and French, where Blender is."""

from __future__ import annotations

from collections.abc import Iterable

import bpy

LANGUAGES = ("de_DE", "fr_FR")
"""In the order of the tables' columns, as Blender calls them."""
CONTEXT = "PrimDiffusion"
"""Of properties whose words mean something else elsewhere in Blender: its French Hair is an animal's, and its own words
win in the contexts that it has."""
_CONTEXTS = ("*", "Operator", CONTEXT)
"""Buttons of operators look their words up in a context of their own."""

Messages = dict[str, dict[tuple[str, str], str]]


def messages(*tables: Iterable[tuple[str, ...]]) -> Messages:
    """Rows of English, German, French as Blender wants them: by language, then by context and English."""
    found: Messages = {language: {} for language in LANGUAGES}
    for table in tables:
        for english, *others in table:
            for language, translated in zip(LANGUAGES, others, strict=True):
                for context in _CONTEXTS:
                    found[language][context, english] = translated
    return found


def register() -> None:
    """Let the words be known to Blender once it has started: the tables would be a tenth of what enabling takes.

    Without a window nothing is shown, and no timer runs.
    """
    bpy.app.timers.register(make_known, persistent=True)


def unregister() -> None:
    """Undo `register` and `make_known`."""
    if bpy.app.timers.is_registered(make_known):
        bpy.app.timers.unregister(make_known)
    bpy.app.translations.unregister(__package__)


def make_known() -> None:
    """Make the words known to Blender."""
    from . import tooltips_of_options, tooltips_of_settings
    from .choices import CHOICES
    from .labels import LABELS
    from .refusals import REFUSALS
    from .tooltips import TOOLTIPS

    tooltips = (TOOLTIPS, tooltips_of_settings.TOOLTIPS, tooltips_of_options.TOOLTIPS)
    bpy.app.translations.register(__package__, messages(LABELS, CHOICES, REFUSALS, *tooltips))
    if bpy.app.translations.locale in LANGUAGES:
        _draw_again()


def _draw_again() -> None:
    """What was drawn before the words were known is English."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            area.tag_redraw()
