"""A new human's picture in the 3D views: where, in which ones, and how long."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import synthetic
from jobs_driven import drive, error_of, until_running
from support.fake_child import DIES, TAKES_LONG

import blender_primdiffusion
from blender_primdiffusion.engine.gpu import billboard
from blender_primdiffusion.engine.gpu.overlay import overlay
from blender_primdiffusion.jobs import picture_in_view as module
from blender_primdiffusion.jobs.follow import follow
from blender_primdiffusion.jobs.generate import GenerateJob
from blender_primdiffusion.jobs.picture_in_view import picture_in_view
from blender_primdiffusion.jobs.pictures import so_far
from blender_primdiffusion.jobs.queue import queue
from blender_primdiffusion.scene.build import build_human

pytestmark = pytest.mark.any_blender
LEVEL = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""A view along +y."""
WIDE = np.diag([0.01, 0.01, 0.01, 1.0]) @ LEVEL
"""Shows 200 m, in parallel."""


def context(shading="SOLID", overlays=True, local_view=None, to_window=WIDE) -> SimpleNamespace:
    """As in the draw handler of a region."""
    space = SimpleNamespace(
        local_view=local_view,
        shading=SimpleNamespace(type=shading),
        overlay=SimpleNamespace(show_overlays=overlays),
    )
    return SimpleNamespace(
        scene=bpy.context.scene,
        space_data=space,
        region_data=SimpleNamespace(view_matrix=LEVEL, perspective_matrix=to_window),
        evaluated_depsgraph_get=bpy.context.evaluated_depsgraph_get,
    )


def shown() -> bool:
    return picture_in_view.drawn_in(context())


@pytest.fixture
def redraws(monkeypatch) -> list[bool]:
    """Whether a picture is shown at each redrawing of the 3D views."""
    found = []
    monkeypatch.setattr(module, "redraw_views", lambda: found.append(shown()))
    return found


@pytest.fixture
def denoising(addon, redraws):
    """The context of a job whose first picture has come."""
    queue.add(addon, GenerateJob(TAKES_LONG, {"steps": 5}))
    until_running()
    follow()
    assert shown()
    return addon


def test_the_picture_goes_when_the_job_is_cancelled(denoising, redraws):
    bpy.ops.primdiffusion.cancel()
    drive()
    assert not shown()
    assert redraws == [True, False], "once for each picture, and once without"


def test_the_picture_goes_when_the_job_fails(addon, redraws):
    queue.add(addon, GenerateJob(DIES, {"steps": 3}))
    drive()
    assert error_of("generate")
    assert redraws == [True, False]


def test_the_picture_goes_when_the_human_stands(addon, redraws):
    queue.add(addon, GenerateJob(7, {"steps": 3}))
    drive()
    assert redraws == [True, False]
    assert bpy.data.objects["Human"]


def test_loading_a_file_and_unregistering_remove_the_picture(denoising):
    picture_in_view._texture = "uploaded"
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert (picture_in_view._pixels, picture_in_view._texture) == (None, None)
    queue.add(bpy.context, GenerateJob(TAKES_LONG, {"steps": 5}))
    until_running()
    follow()
    assert shown()
    blender_primdiffusion.unregister()
    assert (picture_in_view._pixels, picture_in_view._texture) == (None, None)
    assert so_far.shown is None
    blender_primdiffusion.register()


def test_only_views_that_show_humans_of_the_jobs_scene_show_the_picture(denoising):
    settings = bpy.context.scene.primdiffusion_render
    settings.in_viewports = False
    assert not shown()
    settings.in_viewports = True
    assert not picture_in_view.drawn_in(context(local_view=bpy.context))
    bpy.context.scene.render.engine = "PRIMDIFFUSION"
    assert picture_in_view.drawn_in(context("RENDERED"))
    assert not picture_in_view.drawn_in(context("RENDERED", overlays=False))
    elsewhere = context()
    elsewhere.scene = bpy.data.scenes.new("Other")
    assert not picture_in_view.drawn_in(elsewhere)


def test_a_picture_is_uploaded_once_and_drawn_where_the_human_will_stand(denoising, tmp_path, monkeypatch):
    uploaded, drawn, prepared = [], [], []
    monkeypatch.setattr(billboard, "texture_of", lambda pixels: uploaded.append(pixels.shape) or "texture")
    monkeypatch.setattr(billboard, "draw", lambda texture, corners: drawn.append(corners))
    monkeypatch.setattr(overlay, "prepare", lambda: prepared.append(len(drawn)))
    bpy.context.scene.cursor.location = (3, 4, 0.5)
    picture_in_view.draw(context())
    np.testing.assert_allclose(drawn[0].mean(0)[:2], [3, 4], atol=1e-6)
    bpy.context.scene.cursor.location = (5, 4, 0.5)
    picture_in_view.draw(context())
    np.testing.assert_allclose(drawn[1].mean(0)[:2], [5, 4], atol=1e-6)
    assert uploaded == [(8, 8, 4)]
    assert prepared == [0, 1], "the human's shaders are compiled meanwhile"
    build_human(bpy.context, synthetic.write(tmp_path / "one", 4))
    bpy.context.scene.cursor.location = (0.5, 0, 0)
    picture_in_view.draw(context())
    assert drawn[2].mean(0)[0] > 1.5, "beside the human there"
    bpy.ops.mesh.primitive_cube_add(location=(0.5, 0, 0))
    bpy.context.scene.cursor.location = (0.501, 0, 0)
    picture_in_view.draw(context())
    assert drawn[3].mean(0)[1] < -1, "in front of the cube there"


def test_a_view_that_shows_less_than_half_of_the_picture_does_without(denoising, monkeypatch):
    drawn = []
    monkeypatch.setattr(billboard, "texture_of", lambda pixels: "texture")
    monkeypatch.setattr(billboard, "draw", lambda texture, corners: drawn.append(corners))
    monkeypatch.setattr(overlay, "prepare", lambda: None)
    narrow = np.diag([1.0, 1.0, 0.01, 1.0]) @ LEVEL  # 2 m around the world's origin
    for x, count in ((0.0, 1), (0.9, 2), (1.1, 2), (30.0, 2)):
        bpy.context.scene.cursor.location = (x, 0, -0.9)
        picture_in_view.draw(context(to_window=narrow))
        assert len(drawn) == count, x
    behind = np.diag([1.0, 1.0, 1.0, 1.0])
    behind[3] = [0, 1.0, 0, 0]  # a camera at the origin that looks along +y
    bpy.context.scene.cursor.location = (0, -5, -0.9)
    picture_in_view.draw(context(to_window=behind))
    assert len(drawn) == 2


def test_edits_show_no_picture_in_the_views(denoising, monkeypatch):
    monkeypatch.setattr(GenerateJob, "new_person", False)
    follow()
    assert not shown()


def test_without_a_window_there_is_no_handler(addon):
    assert module._handlers == []
