"""The interface in other languages: every word and sentence is there, no row is left over, and Blender takes them."""

from __future__ import annotations

import time

import bpy
import pytest
from shown_words import said_by_blender, said_in_sentences

from blender_primdiffusion.scene.shape_names import BETAS
from blender_primdiffusion.ui import translations
from blender_primdiffusion.ui.translations import told as sentences
from blender_primdiffusion.ui.translations import tooltips_of_options, tooltips_of_settings
from blender_primdiffusion.ui.translations.choices import CHOICES
from blender_primdiffusion.ui.translations.labels import LABELS, SAME
from blender_primdiffusion.ui.translations.refusals import REFUSALS
from blender_primdiffusion.ui.translations.sentences import SENTENCES
from blender_primdiffusion.ui.translations.told import told
from blender_primdiffusion.ui.translations.tooltips import TOOLTIPS

WORDS = (*LABELS, *CHOICES, *REFUSALS, *TOOLTIPS, *tooltips_of_settings.TOOLTIPS, *tooltips_of_options.TOOLTIPS)
NEVER_SHOWN = {
    "no answer waits: call tick until ready",
    "{} is not kept",
    "there are two kinds of work {}: give one another name",
    "the backend was shut down while it was starting",
    "a PNG of {} {} cannot be written: give uint8 or uint16 [H, W(, 3 or 4)]",
    "a motion of {} frames has rotations [{}, 24, 3, 3] and translations [{}, 3]; given are {} and {}",
    "a pose is {} axis-angle vectors of finite numbers, not {}",
    "poses have shapes {} and {}; {} frames need {} and {}",
    "frame numbers must increase from key to key; sort them and drop doubles",
    "{}=={} --hash=sha256:{}",
    "{}, {} GB{}",
    "{}{}, Python {}.{}",
    "Environment and caches are deleted{}",
    "{} to {}",
    "this client has been started before: make a new one",
    "this child has been closed: make a new one",
}
"""Defects of programs that call wrongly, and sentences that are made of others: those are rows."""


def made_of_values() -> set[str]:
    """Words that are put together where they are shown."""
    from blender_primdiffusion.ui.human.shape_panel import _SHOWN
    from blender_primdiffusion.worker.job import STAGES

    sliders = {f"Shape {index + 1}" for index in range(BETAS)} | {"Stature", "Shoulders", "Waist", "Girth"}
    facts = {"Rig", "Up Axis", "Frames", "Frame Rate", "Units", "Bones", "Stride"}
    facts |= {"Volumes", "Files", "Memory once drawn"}
    more = {"Whatever comes", "A pose of your own", "A built-in pose"}
    more |= {"Show Volumes", "Show Mesh", "Show Mesh in Viewport"}
    return sliders | facts | more | {name.capitalize() for name in _SHOWN} | set(STAGES.values()) | {"Any"}


BY_OTHERS = {"Add Preset", "Menu Name", "Name", "Remove"}
"""Words of Blender's own mix-ins."""


@pytest.fixture(params=range(len(translations.LANGUAGES)), ids=translations.LANGUAGES)
def language(request, monkeypatch):
    """As if Blender were in it: its Python module has no languages."""
    monkeypatch.setattr(sentences, "shown_language", lambda: request.param)
    return request.param


def is_known(text: str) -> object:
    """A sentence, or each of several, has a row."""
    pieces = sentences._PIECES.split(text)
    if len(pieces) > 1 and all(map(is_known, pieces)):
        return True
    body = text.removesuffix(".").removesuffix(";").strip()
    return {text, body} & (SAME | {row[0] for row in WORDS}) or any(
        pattern.fullmatch(body) for pattern, _ in sentences._patterns()
    )


def test_every_word_that_blender_looks_up_is_translated(addon):
    missing = said_by_blender() - {row[0] for row in WORDS} - SAME
    assert not missing, "add to ui/translations:\n" + "\n".join(sorted(missing))


def test_every_sentence_is_translated():
    said = {text: where for text, where in said_in_sentences().items() if text not in NEVER_SHOWN}
    missing = sorted(f"{where}: {text}" for text, where in said.items() if not is_known(text))
    assert not missing, "add to ui/translations/sentences:\n" + "\n".join(missing)


def test_choices_of_the_default_checkpoint_and_all_poses_are_translated():
    from blender_primdiffusion.motion.library_poses import LIBRARY
    from blender_primdiffusion.ui.generate.attributes import CATEGORIES, menu

    shown = {item[1] for name in CATEGORIES for item in menu(name)} | set(LIBRARY)
    missing = shown - {row[0] for row in WORDS} - SAME
    assert not missing, missing


def test_names_of_shape_sliders_are_translated():
    assert {f"Shape {index + 1}" for index in range(BETAS)} <= {row[0] for row in LABELS}


def test_no_word_is_left_over(addon):
    used = said_by_blender() | set(said_in_sentences()) | BY_OTHERS
    rows = (*LABELS, *REFUSALS, *TOOLTIPS, *tooltips_of_settings.TOOLTIPS, *tooltips_of_options.TOOLTIPS)
    stale = [row[0] for row in rows if row[0] not in used | made_of_values()]
    assert not stale, f"nobody says this any more: {stale}"


def test_rows_are_complete_and_none_is_there_twice():
    for rows in (WORDS, SENTENCES):
        assert all(len(row) == 1 + len(translations.LANGUAGES) and all(word.strip() for word in row) for row in rows)
        twice = {row[0] for row in rows if sum(other[0] == row[0] for other in rows) > 1}
        assert not twice, twice
    assert not [row for row in (*WORDS, *SENTENCES) if any(word.endswith(".") and word[-3:] != "..." for word in row)]
    assert not {row[0] for row in LABELS} & SAME


def test_translated_sentences_take_the_same_values():
    for english, *others in SENTENCES:
        values = [f"value {number}" for number in range(english.count("{}"))]
        for other in others:
            assert all(value in other.format(*values) for value in values), (english, other)


def test_values_stay_and_causes_in_them_are_translated(language):
    german = language == 0
    assert told("The pose 'Bow' is in the library.") == (
        "Die Pose 'Bow' ist in der Bibliothek." if german else "La pose 'Bow' est dans la bibliothèque."
    )
    cause = "no Python for the backend: /x does not exist. To go on, press Set Up Backend, or name a Python with "
    shown = told(cause + "PrimDiffusion's packages in the extension's preferences.")
    assert ("/x gibt es nicht" if german else "/x n'existe pas") in shown
    assert ("„Backend einrichten“" if german else "« Installer le moteur »") in shown


def test_several_sentences_are_translated_one_by_one_and_unknown_ones_stay(language):
    shown = told("The backend crashed (signal 11). Try again. Whatever nobody wrote down.")
    assert shown.endswith(" Whatever nobody wrote down.")
    assert "Try again" not in shown
    assert "crashed" not in shown
    assert told("") == ""


def test_in_english_nothing_changes():
    assert told("Nobody is in the scene: generate a person first.") == (
        "Nobody is in the scene: generate a person first."
    )


def test_words_are_known_by_language_and_context():
    made = translations.messages([("Seed", "Startwert", "Graine")])
    assert made["de_DE"] == {(context, "Seed"): "Startwert" for context in ("*", "Operator", translations.CONTEXT)}
    assert made["fr_FR"]["*", "Seed"] == "Graine"


def test_making_them_known_is_left_until_blender_has_started_takes_milliseconds_and_is_undone(empty_scene):
    translations.register()
    assert bpy.app.timers.is_registered(translations.make_known)
    translations.unregister()  # before they are known
    assert not bpy.app.timers.is_registered(translations.make_known)
    began = time.process_time()
    translations.make_known()
    took = time.process_time() - began
    translations.unregister()
    translations.make_known()
    translations.unregister()
    assert took < 0.02


def test_blender_shows_them_where_it_has_languages(addon):
    view = bpy.context.preferences.view
    try:
        view.language = "de_DE"
    except TypeError:
        pytest.skip("this build of Blender has no languages")
    translations.make_known()
    try:
        assert bpy.app.translations.pgettext_iface("Generate Human") == "Mensch erzeugen"
    finally:
        view.language = "en_US"
