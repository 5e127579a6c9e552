"""The sidebar as it opens: tabs, panels, heights, reasons beside grey buttons; text wrapped in panels."""

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import MagicMock

import bpy
import pytest
import synthetic_shape
from blend_tampering import in_preferences
from jobs_driven import Layout
from shown_words import classes

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
import sidebar

from blender_primdiffusion.backend.requests import RequestError
from blender_primdiffusion.jobs.queue import JobOutcome, queue
from blender_primdiffusion.jobs.variations import Variation, sheet
from blender_primdiffusion.scene import shape
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human_file import shape_model_of
from blender_primdiffusion.ui import drawing, generate_panel

pytestmark = pytest.mark.any_blender
SMALL_WINDOW_PX = 620
"""Of the sidebar in a window of 1400 x 900 pixels, above the timeline."""
MOST_PANELS, MOST_OPERATORS = 20, 40


@pytest.fixture
def human(addon, tmp_path, monkeypatch):
    """One human, whose sliders have names, after Generate Human."""
    human = build_human(addon, synthetic_shape.write(tmp_path / "human"))
    vertices = len(shape_model_of(human).template)
    monkeypatch.setattr(shape, "DEFAULT_BODY_VERTICES", vertices)
    monkeypatch.setattr(generate_panel, "draw_set_up", lambda _layout: True)
    outcome = JobOutcome(MagicMock(), "Generated in 47.6 s, and after that built in 2.9 s.")
    monkeypatch.setitem(queue.outcomes, "generate", outcome)
    return human


def test_captures_are_shown_where_the_preferences_ask_for_them(human):
    captures = bpy.types.PRIMDIFFUSION_PT_captures
    with in_preferences():
        assert not captures.poll(bpy.context)
        bpy.context.preferences.addons["blender_primdiffusion"].preferences.captures = True
        assert captures.poll(bpy.context)
    assert list(sidebar.tabs(bpy.context)) == ["PrimDiffusion"]


def test_panels_and_operators_are_few(human):
    figures = sidebar.figures(bpy.context)
    assert figures["panel_classes"] <= MOST_PANELS
    assert figures["operators"] <= MOST_OPERATORS
    before = figures["operators"]
    another = type(
        "PRIMDIFFUSION_OT_another", (bpy.types.Operator,), {"bl_idname": "primdiffusion.another", "bl_label": "A"}
    )
    bpy.utils.register_class(another)
    try:
        assert sidebar.figures(bpy.context)["operators"] == before + 1
    finally:
        bpy.utils.unregister_class(another)


def test_a_panel_is_in_the_tab_of_the_panel_around_it(addon):
    panels = {getattr(cls, "bl_idname", cls.__name__): cls for cls in sidebar.panels()}
    for cls in panels.values():
        if parent := getattr(cls, "bl_parent_id", ""):
            assert cls.bl_category == panels[parent].bl_category, cls.__name__


def test_the_panels_open_at_first_are_those_of_the_first_steps(human):
    names = [cls.__name__.removeprefix("PRIMDIFFUSION_PT_") for cls in sidebar.open_panels(bpy.context)]
    assert sorted(names) == ["generate", "human"]


def test_with_one_human_the_tab_fits_a_small_window(human):
    assert max(sidebar.tabs(bpy.context).values()) <= SMALL_WINDOW_PX
    assert sidebar.figures(bpy.context)["panels_open"] == 2


def test_heights_are_those_of_a_screenshot():
    """Blender 5.2.2 at an interface scale of 1.05: 268 px from a field over ten sliders and a row to the next row."""
    layout = sidebar.Layout()
    layout.label()
    column = layout.column(align=True)
    for _ in range(10):
        column.label()
    layout.row().label()
    layout.row().label()
    assert (layout.height - sidebar.ROW) * 1.05 == pytest.approx(268, abs=2)


def drawn() -> Iterator[tuple[type, sidebar.Layout]]:
    """Every panel of the sidebar with its sections opened, and each edit."""
    settings = bpy.context.scene.primdiffusion_edit
    for cls in sidebar.panels():
        edit = cls.__name__ == "PRIMDIFFUSION_PT_human"
        for kind in settings.bl_rna.properties["kind"].enum_items.keys() if edit else [settings.kind]:
            settings.kind = kind
            yield cls, sidebar.draw(cls, bpy.context, opened=True)


@pytest.mark.parametrize("situation", ["no backend", "one human", "variations", "all variations"])
def test_no_button_is_grey_without_a_reason_in_the_panel(human, monkeypatch, tmp_path, situation):
    if situation == "no backend":
        monkeypatch.setattr(generate_panel, "draw_set_up", lambda _layout: False)
    if "variations" in situation:
        monkeypatch.setattr("blender_primdiffusion.ui.variations_panel._draw_picture", lambda *_: None)
        chosen = situation == "all variations"
        monkeypatch.setattr(sheet, "variations", [Variation(seed, tmp_path, chosen) for seed in range(3)])
    grey = set()
    for cls, layout in drawn():
        for button in layout.buttons:
            if button.grey:
                grey.add(button.idname.removeprefix("primdiffusion."))
                assert any(re.match(r"(Set up|Choose|Select|Wait)", text) for text in layout.texts), cls.__name__
    always = {"transfer_texture", "blend", "human_from_picture"}
    more = {
        "no backend": {"generate"},
        "one human": set(),
        "variations": {"build_variation", "variations"},
        "all variations": {"variations"},
    }
    assert grey == always | more[situation]


def test_an_operator_gives_a_reason_only_where_it_is_disabled(human):
    """Else Blender would show that reason on a button that is grey for another one."""
    for cls in classes(bpy.types.Operator):
        poll = getattr(cls, "poll", None)
        if not getattr(poll, "__module__", "").startswith("blender_primdiffusion"):
            continue
        said: list[str] = []
        allowed = poll.__func__(type("Stub", (), {"poll_message_set": staticmethod(said.append)}), bpy.context)
        assert bool(said) != allowed, cls.__name__


@pytest.mark.parametrize(
    ("kind", "sentence", "in_preferences"),
    [
        ("environment", "torch is missing", True),
        ("missing_file", "there is no checkpoint at /nowhere/model.safetensors", True),
        ("missing_file", "there is no file /elsewhere/anna.human", False),
    ],
)
def test_an_error_leads_to_the_preferences_where_they_are_at_fault(addon, monkeypatch, kind, sentence, in_preferences):
    monkeypatch.setattr(drawing, "preference", {"checkpoint": "/nowhere/model.safetensors"}.get)
    layout = Layout()
    drawing._draw_outcome(layout, JobOutcome(MagicMock(), error=RequestError(sentence, "", kind)))
    assert layout.of("button") == [*(["preferences.addon_show"] if in_preferences else []), "wm.path_open"]
