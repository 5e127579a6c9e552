"""A Rendered view: what it says where it cannot be drawn, and which picture goes over Blender's overlays."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from blender_primdiffusion.engine import viewport
from blender_primdiffusion.engine.viewport import Viewport

pytestmark = pytest.mark.any_blender


class Engine:
    """Stands in for Blender's side of a view."""

    def __init__(self):
        self.stats = []

    def update_stats(self, _: str, text: str) -> None:
        self.stats.append(text)


@pytest.fixture
def drawn(addon, monkeypatch):
    """Draws a view of an empty scene, at each call; what it then says. `follow` would let Blender march on."""
    followed = []
    monkeypatch.setattr(viewport, "follow", lambda: followed.append(True))
    view, engine, matrix = Viewport(), Engine(), np.diag([1.0, 1.0, -0.01, 1.0])
    space = SimpleNamespace(local_view=None, clip_start=0.1, clip_end=100.0, camera=None, use_render_border=False)
    around = SimpleNamespace(window_matrix=matrix, view_matrix=np.eye(4), is_perspective=True, view_perspective="PERSP")
    context = SimpleNamespace(
        region=SimpleNamespace(as_pointer=lambda: 7, width=8, height=8), region_data=around, space_data=space
    )

    def draw() -> str:
        depsgraph = bpy.context.evaluated_depsgraph_get()
        view.update(context, depsgraph)
        view.draw(engine, context, depsgraph)
        return engine.stats[-1]

    return SimpleNamespace(view=view, draw=draw, followed=followed, scene=bpy.context.scene)


def test_a_gpu_that_cannot_draw_is_one_sentence_and_not_asked_again(drawn, monkeypatch):
    asked = []

    def march(*_given: object) -> None:
        asked.append(True)
        raise RuntimeError("this GPU has no compute shaders")

    monkeypatch.setattr(drawn.view, "_march", march)
    assert drawn.draw() == "PrimDiffusion: this GPU has no compute shaders"
    assert drawn.draw() == "PrimDiffusion: this GPU has no compute shaders"
    assert len(asked) == 1
    assert drawn.view.resting
    assert drawn.followed == []


def test_a_human_that_cannot_be_drawn_is_named_until_the_scene_changes(drawn, monkeypatch):
    def march(*_given: object) -> None:
        raise ValueError("Anna is damaged: import her again")

    monkeypatch.setattr(drawn.view, "_march", march)
    assert drawn.draw() == "PrimDiffusion: Anna is damaged: import her again"
    assert drawn.view.resting
    monkeypatch.setattr(drawn.view, "_march", lambda *_given: None)
    assert drawn.draw() == ""


def test_a_view_says_where_renders_show_something_else(drawn, monkeypatch):
    monkeypatch.setattr(drawn.view, "_march", lambda *_given: None)
    assert drawn.draw() == ""
    drawn.scene.primdiffusion_render.view = "BOXES"
    assert drawn.draw() == "PrimDiffusion: 3D views show Colour; render the image to see Primitives"


def view_of(address: int, transform: str = "Standard", exposure: float = 0.0) -> SimpleNamespace:
    settings = SimpleNamespace(view_transform=transform, look="None", exposure=exposure, gamma=1.0)
    return SimpleNamespace(
        scene=SimpleNamespace(view_settings=settings), region=SimpleNamespace(as_pointer=lambda: address)
    )


@pytest.fixture
def shown():
    """A viewport of region 7 that shows a marched picture."""
    made = Viewport()
    made.region, made._texture = 7, ("mean", None)
    made._refinement.shown = SimpleNamespace(picture=SimpleNamespace(humans=SimpleNamespace(depth="depth")))
    return made


def test_the_marched_picture_has_the_colours_that_are_shown_and_the_humans_depth(shown):
    picture = viewport.picture_above_overlays(view_of(7))
    assert (picture.colour, picture.depth) == ("mean", "depth")
    assert viewport.picture_above_overlays(view_of(8)) is None


def test_colours_that_a_handler_cannot_show_stay_below(shown):
    assert viewport.picture_above_overlays(view_of(7, "AgX")) is None
    assert viewport.picture_above_overlays(view_of(7, exposure=1.0)) is None
    shown._texture = ("mean", (0, 0, 8, 8))
    assert viewport.picture_above_overlays(view_of(7)) is None
