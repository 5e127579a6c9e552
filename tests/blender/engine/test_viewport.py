"""A Rendered view: what it says where it cannot be drawn, and how it is refined."""

import time
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from blender_primdiffusion.engine import viewport
from blender_primdiffusion.engine.view import renders_volumes, view_engine
from blender_primdiffusion.engine.viewport import Viewport
from blender_primdiffusion.scene.build import build_human

SIZE = (48, 64)
SAMPLE = Path(viewport.__file__).parents[1] / "gallery" / "Sample.human"


class Engine:
    """Stands in for Blender's side of a view."""

    def __init__(self):
        self.stats, self.redraws = [], 0

    def tag_redraw(self) -> None:
        self.redraws += 1

    def update_stats(self, _: str, text: str) -> None:
        self.stats.append(text)

    def bind_display_space_shader(self, _scene: object) -> None:
        pass

    def unbind_display_space_shader(self) -> None:
        pass


@pytest.fixture
def drawn(addon):
    """Draws the scene, looking along y in parallel, at each call; what the view then says."""
    view, engine, matrix = Viewport(), Engine(), np.diag([1.0, 0.75, -0.01, 1.0])
    space = SimpleNamespace(local_view=None)
    to_view = np.array([[1.0, 0, 0, 0], [0, 0, 1, -1.0], [0, -1, 0, 0], [0, 0, 0, 1]])
    around = SimpleNamespace(window_matrix=matrix, view_matrix=to_view, view_perspective="PERSP")
    region = SimpleNamespace(as_pointer=lambda: 7, width=SIZE[0], height=SIZE[1])
    context = SimpleNamespace(region=region, region_data=around, space_data=space)

    def draw() -> str:
        depsgraph = bpy.context.evaluated_depsgraph_get()
        view.update(context, depsgraph)
        view.draw(engine, context, depsgraph)
        return engine.stats[-1]

    return SimpleNamespace(view=view, draw=draw, engine=engine, space=space, scene=bpy.context.scene)


@pytest.mark.any_blender
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
    assert drawn.engine.redraws == 0


@pytest.mark.any_blender
def test_a_human_that_cannot_be_drawn_is_named_until_the_scene_changes(drawn, monkeypatch):
    def march(*_given: object) -> None:
        raise ValueError("Anna is damaged: import her again")

    monkeypatch.setattr(drawn.view, "_march", march)
    assert drawn.draw() == "PrimDiffusion: Anna is damaged: import her again"
    assert drawn.view.resting
    monkeypatch.setattr(drawn.view, "_march", lambda *_given: None)
    assert drawn.draw() == ""


def refined(drawn) -> np.ndarray:
    """The picture [h, w, 4], from the bottom, once the view rests; drawn as often as the engine asks for it."""
    for draws in range(1, 500):
        assert drawn.draw() == ""
        if drawn.engine.redraws < draws:
            break
        time.sleep(0.01)
    drawn.engine.redraws = 0
    texture = drawn.view._texture
    return np.array(texture.read()).reshape(texture.height, texture.width, 4)


def test_a_view_is_refined_to_the_end(marcher, drawn):
    drawn.scene.render.film_transparent = True
    human = build_human(bpy.context, SAMPLE)
    bpy.context.view_layer.update()
    whole = refined(drawn)
    assert whole.shape == (SIZE[1], SIZE[0], 4)
    assert drawn.view._refinement.shown.coarseness == 1
    assert drawn.view._refinement.shown.sample > 0
    assert 0.05 < (whole[..., 3] > 0.99).mean() < 0.3
    assert viewport.below_overlays[7] is drawn.view._refinement.shown.picture.humans
    human.location.x = 5.0
    bpy.context.view_layer.update()
    assert not refined(drawn).any()


EEVEE = "BLENDER_EEVEE"
SHADINGS = ("WIREFRAME", "SOLID", "MATERIAL", "RENDERED")


def with_volumes(engine: str) -> list[bool]:
    return [renders_volumes(view_engine(engine, shading)) for shading in SHADINGS]


@pytest.mark.any_blender
def test_views_with_light_leave_humans_to_engines_that_render_their_volumes(addon):
    for engine in ("CYCLES", EEVEE):
        assert with_volumes(engine) == [False, False, True, True]
    assert with_volumes("BLENDER_WORKBENCH") == [False, False, True, False], "Material Preview is EEVEE's"
    assert with_volumes("PRIMDIFFUSION") == [False, False, True, False]


@pytest.mark.any_blender
def test_the_engine_draws_its_own_view_and_no_other(addon):
    assert [view_engine("PRIMDIFFUSION", shading) == "PRIMDIFFUSION" for shading in SHADINGS] == [False] * 3 + [True]
    assert view_engine("PRIMDIFFUSION", "SOLID") == "BLENDER_WORKBENCH"


@pytest.mark.any_blender
def test_an_engine_declares_that_it_renders_volumes_as_blenders_own_do(addon):
    assert not renders_volumes("SOMEBODYS")
    engines = bpy.types.DATA_PT_volume_file.COMPAT_ENGINES
    engines.add("SOMEBODYS")
    try:
        assert renders_volumes("SOMEBODYS")
    finally:
        engines.discard("SOMEBODYS")
