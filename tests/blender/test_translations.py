"""The interface in other languages: every label has its words, no word is left over, and Blender takes them."""

from __future__ import annotations

import re
import time

import bpy
import pytest
from test_tooltips import labels, tooltips

from blender_primdiffusion.ui import translations
from blender_primdiffusion.ui.translations.labels import LABELS, SAME
from blender_primdiffusion.ui.translations.tooltips import TOOLTIPS

OPERATOR = re.compile(r"^PRIMDIFFUSION_OT_[^.]*$")
_BY_OTHERS = {"Add Preset", "Menu Name", "Name", "Remove"}


def test_every_label_is_translated(addon):
    known = {row[0] for row in LABELS} | SAME
    missing = sorted({label for _, label in labels() if label} - known)
    assert not missing, f"add to ui/translations/labels.py: {missing}"


def test_most_operators_tooltips_are_translated(addon):
    known = {row[0] for row in TOOLTIPS}
    said = {where: text for where, text in tooltips() if OPERATOR.match(where)}
    missing = [f"{where}: {text}" for where, text in said.items() if text not in known]
    assert len(missing) <= 0.2 * len(said), "add to ui/translations/tooltips.py:\n" + "\n".join(missing)


def test_no_row_is_left_over(addon):
    used = {label for _, label in labels()} | {text for _, text in tooltips()} | _BY_OTHERS
    stale = [row[0] for row in (*LABELS, *TOOLTIPS) if row[0] not in used]
    assert not stale, f"nobody says this any more: {stale}"


def test_rows_are_complete_and_no_row_is_there_twice():
    rows = [*LABELS, *TOOLTIPS]
    assert all(len(row) == 1 + len(translations.LANGUAGES) and all(word.strip() for word in row) for row in rows)
    assert len({row[0] for row in rows}) == len(rows)
    assert not [row for row in TOOLTIPS if any(word.endswith(".") for word in row)]
    assert not {row[0] for row in LABELS} & SAME


def test_words_are_known_by_language_and_context():
    made = translations.messages([("Seed", "Startwert", "Graine")])
    assert made["de_DE"] == {("*", "Seed"): "Startwert", ("Operator", "Seed"): "Startwert"}
    assert made["fr_FR"]["*", "Seed"] == "Graine"


def test_making_them_known_takes_milliseconds_and_is_undone(empty_scene):
    began = time.process_time()
    translations.register()
    took = time.process_time() - began
    translations.unregister()
    translations.register()
    translations.unregister()
    assert took < 0.02


def test_blender_shows_them_where_it_has_languages(addon):
    view = bpy.context.preferences.view
    try:
        view.language = "de_DE"
    except TypeError:
        pytest.skip("this build of Blender has no languages")
    try:
        assert bpy.app.translations.pgettext_iface("Generate Human") == "Mensch erzeugen"
    finally:
        view.language = "en_US"
