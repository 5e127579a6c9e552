"""Which engine draws which 3D view, and whether it draws the volumes of humans."""

import bpy
import pytest

from blender_primdiffusion.engine.view import renders_volumes, view_engine

pytestmark = pytest.mark.any_blender
EEVEE = "BLENDER_EEVEE"
SHADINGS = ("WIREFRAME", "SOLID", "MATERIAL", "RENDERED")


def with_volumes(engine: str) -> list[bool]:
    return [renders_volumes(view_engine(engine, shading)) for shading in SHADINGS]


def test_views_with_light_leave_humans_to_engines_that_render_their_volumes(addon):
    for engine in ("CYCLES", EEVEE):
        assert with_volumes(engine) == [False, False, True, True]
    assert with_volumes("BLENDER_WORKBENCH") == [False, False, True, False], "Material Preview is EEVEE's"
    assert with_volumes("PRIMDIFFUSION") == [False, False, True, False]


def test_the_engine_draws_its_own_view_and_no_other(addon):
    assert [view_engine("PRIMDIFFUSION", shading) == "PRIMDIFFUSION" for shading in SHADINGS] == [False] * 3 + [True]
    assert view_engine("PRIMDIFFUSION", "SOLID") == "BLENDER_WORKBENCH"


def test_an_engine_declares_that_it_renders_volumes_as_blenders_own_do(addon):
    assert not renders_volumes("SOMEBODYS")
    engines = bpy.types.DATA_PT_volume_file.COMPAT_ENGINES
    engines.add("SOMEBODYS")
    try:
        assert renders_volumes("SOMEBODYS")
    finally:
        engines.discard("SOMEBODYS")
