"""A synthetic human for the tests of its panels."""

import bpy
import pytest
import synthetic

from blender_primdiffusion.scene.build import build_human


@pytest.fixture
def armature(addon, tmp_path) -> bpy.types.Object:
    """Of a human with the name Ann."""
    return build_human(addon, synthetic.write(tmp_path / "p", 8), "Ann")
