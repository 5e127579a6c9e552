"""Sentences in the language of the interface: errors and news, which are made in English with values in them."""

from __future__ import annotations

import functools
import re

import bpy

from . import LANGUAGES

_PIECES = re.compile(r"(?<=[.!?;]) ")
_KEPT = 1024
"""Sentences; those with numbers in them change at each step of a work."""


def told(text: str) -> str:
    """`text` as it is shown: in German or French where Blender is, if it is a row of `sentences` or several of them.

    Values within are looked up too: causes and remedies. What is unknown stays English.
    """
    language = shown_language()
    return text if language is None or not text else _told(text, language)


def shown_language() -> int | None:
    """Place of the interface's language in LANGUAGES; None: English, or one that we have no words of."""
    locale = bpy.app.translations.locale
    if locale not in LANGUAGES or not bpy.context.preferences.view.use_translate_interface:
        return None
    return LANGUAGES.index(locale)


@functools.lru_cache(maxsize=_KEPT)
def _told(text: str, language: int) -> str:
    body = text.removesuffix(".")
    for pattern, row in _patterns():
        if (found := pattern.fullmatch(body)) is not None:
            values = (_told(value, language) if value else value for value in found.groups())
            said = row[1 + language].format(*values)
            if body[0].isupper():
                said = said[0].upper() + said[1:]
            return said + text[len(body) :]
    pieces = _PIECES.split(text)
    if len(pieces) == 1:
        return text
    return " ".join(_told(piece.removesuffix(";"), language) + ";" * piece.endswith(";") for piece in pieces)


@functools.cache
def _patterns() -> list[tuple[re.Pattern[str], tuple[str, str, str]]]:
    """Of all rows, those with the most letters of their own first: "{}: {}" would match much."""
    from .labels import LABELS
    from .refusals import REFUSALS
    from .sentences import SENTENCES

    rows = sorted((*SENTENCES, *LABELS, *REFUSALS), key=lambda row: -len(row[0].replace("{}", "")))
    return [(_pattern(row[0]), row) for row in rows]


def _pattern(english: str) -> re.Pattern[str]:
    """Matches the sentence with any values, whether it begins with a capital or not."""
    first, rest = english[0], english[1:]
    begins = f"[{first.lower()}{first.upper()}]" if first.isalpha() else re.escape(first)
    if first == "{":
        begins, rest = "", english
    return re.compile(begins + "(.*?)".join(map(re.escape, rest.split("{}"))), re.DOTALL)
