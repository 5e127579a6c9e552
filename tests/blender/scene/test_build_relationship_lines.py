"""The overlay that would hide people in the viewport."""

from __future__ import annotations

import bpy
import pytest
import synthetic

from blender_primdiffusion.scene.build import build_human


@pytest.fixture
def default_scene(tmp_path):
    """Blender's start-up file, with its workspaces."""
    bpy.ops.wm.read_factory_settings()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    return bpy.context


def test_a_new_person_is_not_hidden_behind_lines_to_bones(default_scene, tmp_path):
    spaces = [s for screen in bpy.data.screens for area in screen.areas for s in area.spaces if s.type == "VIEW_3D"]
    assert any(space.overlay.show_relationship_lines for space in spaces)
    build_human(default_scene, synthetic.write(tmp_path / "human", 4))
    assert not any(space.overlay.show_relationship_lines for space in spaces)
