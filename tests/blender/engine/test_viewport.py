"""Which picture of a Rendered view is drawn again, over Blender's overlays."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from blender_primdiffusion.engine import viewport
from blender_primdiffusion.engine.viewport import Viewport

pytestmark = pytest.mark.any_blender


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
    made._gpu.shown = SimpleNamespace(picture=SimpleNamespace(humans=SimpleNamespace(depth="depth")))
    return made


def test_the_marched_picture_has_the_colours_that_are_shown_and_the_humans_depth(shown):
    picture = viewport.picture_above_overlays(view_of(7))
    assert (picture.colour, picture.depth) == ("mean", "depth")
    assert viewport.picture_above_overlays(view_of(8)) is None


def test_colours_that_a_handler_cannot_show_and_pictures_of_the_child_stay_below(shown):
    assert viewport.picture_above_overlays(view_of(7, "AgX")) is None
    assert viewport.picture_above_overlays(view_of(7, exposure=1.0)) is None
    shown._texture = ("mean", (0, 0, 8, 8))
    assert viewport.picture_above_overlays(view_of(7)) is None
    shown._texture, shown._no_gpu = ("mean", None), "no compute shaders"
    assert viewport.picture_above_overlays(view_of(7)) is None
