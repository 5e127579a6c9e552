"""The interface in other languages: every label and tooltip is there, no word is left over, and Blender takes them."""

from __future__ import annotations

import bpy
import pytest
from shown_words import said_by_blender

from blender_primdiffusion.ui import translations

pytestmark = pytest.mark.any_blender

SAME = frozenset(
    {
        "-X", "-Y", "-Z", "X", "Y", "Z", "4", "8", "12", "16", "CPU", "GPU", "HDRI", "COLMAP", "NeRF", "OpenCV",
        "Cycles", "DDIM", "DDPM", "DPM-Solver++(2M)", "NVIDIA (CUDA)", "Apple", "PrimDiffusion",
        "512 px", "1024 px", "2048 px", "4096 px", "glTF", "FBX", "USD", "A", "T",
    }
)  # fmt: skip
"""Names and numbers that are the same in every language."""
FROM_BLENDER = {"Add Preset", "Menu Name", "Name", "Remove"}
"""Words of Blender's own mix-ins."""
VIEWER = ["The program primdiffusion, or the Python that it is installed in; empty: the program on the PATH"]
"""Words of the viewer build alone."""
WORDS = {language: translations.words_of(language) for language in translations.LANGUAGES}
ENGLISH = WORDS["de_DE"].keys()


def composed() -> set[str]:
    """Labels that are put together where they are shown, and choices that a checkpoint or a folder offers."""
    from blender_primdiffusion.jobs.remedies import _REMEDIES
    from blender_primdiffusion.motion.poses import LIBRARY
    from blender_primdiffusion.ui.advanced_panel import _SHOWN
    from blender_primdiffusion.ui.attributes import CATEGORIES, menu
    from blender_primdiffusion.ui.render_panel import APPROXIMATE, EXACT, OTHER_ENGINE, UNLIT
    from blender_primdiffusion.ui.variations_panel import _BUILD_ALL

    sliders = {"Stature", "Shoulders", "Waist", "Girth"}
    reasons = {"Set up the backend first", "Choose the other human above", EXACT, APPROXIMATE, UNLIT, OTHER_ENGINE}
    facts = {"Rig", "Up Axis", "Frames", "Frame Rate", "Units", "Bones", "Stride"}
    facts |= {"Volumes", "Files", "Memory once drawn"} | {name.capitalize() for name in _SHOWN}
    menus = {item[1] for name in CATEGORIES for item in menu(name)} | set(LIBRARY)
    buttons = {remedy.label for remedy in _REMEDIES.values()}
    menus |= set(VIEWER)
    menus |= {"No preference", "A pose of your own", "A built-in pose"}
    return (
        sliders
        | reasons
        | facts
        | menus
        | buttons
        | {"Show Volumes", "Show Mesh", "Show Mesh in Viewport", "Build Selected", _BUILD_ALL}
    )


def test_every_label_and_tooltip_is_translated(addon):
    missing = (said_by_blender() | composed()) - ENGLISH - SAME
    assert not missing, "add to ui/translations:\n" + "\n".join(sorted(missing))


def test_no_word_is_left_over(addon):
    stale = sorted(ENGLISH - said_by_blender() - composed() - FROM_BLENDER)
    assert not stale, "remove from ui/translations:\n" + "\n".join(stale)


def test_all_languages_have_the_same_words_and_none_is_empty():
    for words in WORDS.values():
        assert words.keys() == ENGLISH
        assert all(word.strip() for word in words.values())
    assert not ENGLISH & SAME


def test_words_are_loaded_after_blender_has_started_and_unloaded_again(empty_scene):
    translations.register()
    assert bpy.app.timers.is_registered(translations.load)
    translations.unregister()  # before they are loaded
    assert not bpy.app.timers.is_registered(translations.load)
    translations.load()
    translations.unregister()
    translations.load()
    translations.unregister()


def test_words_are_known_in_every_context():
    made = translations._in_contexts({"Seed": "Startwert"})
    assert made == {(context, "Seed"): "Startwert" for context in ("*", "Operator", translations.CONTEXT)}


def test_blender_shows_them_where_it_has_languages(addon):
    view = bpy.context.preferences.view
    try:
        view.language = "de_DE"
    except TypeError:
        pytest.skip("this build of Blender has no languages")
    translations.load()
    try:
        assert bpy.app.translations.pgettext_iface("Generate Human") == "Mensch erzeugen"
    finally:
        view.language = "en_US"
