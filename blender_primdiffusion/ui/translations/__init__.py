"""Labels and tooltips in other languages: one file a language, named as Blender names it, English to translation."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...formats.json_files import read_json

LANGUAGES = ("de_DE", "fr_FR")
CONTEXT = "PrimDiffusion"
"""Translation context of words that mean something else elsewhere in Blender (its French Hair is an animal's)."""
_CONTEXTS = ("*", "Operator", CONTEXT)
"""Blender looks up the labels of operator buttons in a context of their own."""


def words_of(language: str) -> dict[str, str]:
    """English -> translation."""
    return read_json(Path(__file__).with_name(f"{language}.json"))


def register() -> None:
    """Load the words once Blender has started: reading the files would slow the start down.

    Without a window nothing is shown, and no timer runs.
    """
    bpy.app.timers.register(load, persistent=True)


def unregister() -> None:
    """Undo `register` and `load`."""
    if bpy.app.timers.is_registered(load):
        bpy.app.timers.unregister(load)
    bpy.app.translations.unregister(__package__)


def load() -> None:
    """Hand the words of all languages to Blender."""
    bpy.app.translations.register(__package__, {language: _in_contexts(words_of(language)) for language in LANGUAGES})
    if bpy.app.translations.locale in LANGUAGES:
        _redraw()


def _in_contexts(words: dict[str, str]) -> dict[tuple[str, str], str]:
    """As Blender wants them: (context, English) -> translation."""
    return {(context, english): word for english, word in words.items() for context in _CONTEXTS}


def _redraw() -> None:
    """What was drawn before is English."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            area.tag_redraw()
