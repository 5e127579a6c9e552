"""Who draws humans in which 3D view, and that the engines that are said to render volumes do."""

import bpy
import pytest

from blender_primdiffusion.engine.who_draws import Drawer, view_engine, who_draws

pytestmark = pytest.mark.any_blender
EEVEE = "BLENDER_EEVEE"
SHADINGS = ("WIREFRAME", "SOLID", "MATERIAL", "RENDERED")


def drawers(engine: str, volumes_shown: bool) -> list[Drawer]:
    return [who_draws(engine, shading, volumes_shown) for shading in SHADINGS]


@pytest.mark.parametrize("engine", ["CYCLES", EEVEE])
def test_views_with_light_leave_humans_to_engines_that_render_their_volumes(addon, engine):
    over, volumes = Drawer.OVERLAY, Drawer.VOLUMES
    assert drawers(engine, True) == [over, over, volumes, volumes]
    assert drawers(engine, False) == [over] * 4, "without volumes the view would be empty"


def test_workbench_shows_a_fog_which_is_drawn_over(addon):
    assert drawers("BLENDER_WORKBENCH", True)[3] is Drawer.OVERLAY
    assert drawers("BLENDER_WORKBENCH", True)[2] is Drawer.VOLUMES, "Material Preview is EEVEE's"


def test_the_engine_draws_its_own_view_and_no_other(addon):
    assert drawers("PRIMDIFFUSION", False) == [Drawer.OVERLAY] * 3 + [Drawer.ENGINE]
    assert who_draws("PRIMDIFFUSION", "RENDERED", True) is Drawer.ENGINE
    assert view_engine("PRIMDIFFUSION", "SOLID") == "BLENDER_WORKBENCH"


def test_an_engine_declares_that_it_renders_volumes_as_blenders_own_do(addon):
    assert who_draws("SOMEBODYS", "RENDERED", True) is Drawer.OVERLAY
    engines = bpy.types.DATA_PT_volume_file.COMPAT_ENGINES
    engines.add("SOMEBODYS")
    try:
        assert who_draws("SOMEBODYS", "RENDERED", True) is Drawer.VOLUMES
    finally:
        engines.discard("SOMEBODYS")
