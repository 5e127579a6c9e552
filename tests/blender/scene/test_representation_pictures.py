"""What is seen of a person in each mode: by Cycles, pixel for pixel, and by the engine, who draws armatures."""

import bpy
import numpy as np
import pytest
import synthetic
import synthetic_shape
from scene_stage import render

from benchmarks.cycles_preview import setup_cycles_preview
from blender_primdiffusion.engine.picture import posed_humans, scene_solids
from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.merged import MergedGrid, MergedState, merged_folder, publish, show_merged, write_grid
from blender_primdiffusion.scene.representation import set_representation

COUNT = 6


@pytest.fixture
def person(saved_scene, tmp_path):
    """A synthetic person in shot.blend."""
    return build_human(saved_scene, synthetic_shape.write(tmp_path / "human", COUNT))


def box_grid(voxel: float, low: tuple, high: tuple, density: float, colour: tuple) -> MergedGrid:
    """One even box [low, high] in the armature's space, metres, on voxel faces, with an empty rim."""
    cells = np.round((np.array(high) - low) / voxel).astype(int)
    filled = np.zeros(cells + 4, np.float16)
    filled[2:-2, 2:-2, 2:-2] = density
    origin = np.array(low) - 1.5 * voxel
    return MergedGrid(filled, np.broadcast_to(np.float16(colour), (*filled.shape, 3)), origin, voxel)


def show_grid(person, grid: MergedGrid, tmp_path) -> None:
    digest = write_grid(grid, tmp_path / "grid.vdb")
    files = publish([tmp_path / "grid.vdb"], [digest], merged_folder())
    show_merged(person, files, MergedState(("",), grid.voxel))


def test_a_merged_box_has_its_colour_opacity_size_and_place_in_cycles(person, tmp_path):
    """By hand: 0.12 m of 10 / m through the usual gain of 1.6 is an alpha of 1 - exp(-1.92)."""
    bpy.utils.expose_bundled_modules()
    voxel, colour = 0.01, (0.6, 0.1, 0.05)
    low, high = (-0.1, -0.06, 0.2), (0.06, 0.06, 0.32)
    show_grid(person, box_grid(voxel, low, high, 10.0, colour), tmp_path)
    set_representation(person, "MERGED")
    camera = setup_cycles_preview(bpy.context.scene, size=96, samples=8)
    camera.data.type, camera.data.ortho_scale = "ORTHO", 0.32
    lift = person.location.z
    camera.location = (0, -3, 0.26 + lift)
    picture = render(tmp_path / "box.exr")
    alpha, metres = picture[..., 3], 0.32 / 96
    middle = alpha[44:52, 32:48]
    np.testing.assert_allclose(middle, 1 - np.exp(-1.6 * 10 * 0.12), atol=0.025)
    inside = alpha > 0.5
    np.testing.assert_allclose(
        picture[..., :3][inside] / alpha[inside][:, None], np.broadcast_to(colour, (inside.sum(), 3)), atol=0.01
    )
    rows, columns = np.nonzero(alpha > 0.45)
    edges = np.array([columns.min(), columns.max() + 1, rows.min(), rows.max() + 1]) - 48
    expected = np.array([low[0], high[0], -(high[2] - 0.26), -(low[2] - 0.26)]) / metres
    np.testing.assert_allclose(edges, expected, atol=1.5)


@pytest.mark.parametrize("mode", ["VOLUMES", pytest.param("MERGED", marks=pytest.mark.any_blender)])
def test_the_engine_draws_the_person_alone_in_every_mode(person, tmp_path, mode):
    bpy.utils.expose_bundled_modules()
    turns = np.zeros((24, 3))
    turns[16, 2] = 0.5
    pose_from_joint_rotations(person, synthetic.axis_angle(turns))
    bpy.context.view_layer.update()
    expected = posed_humans(bpy.context.evaluated_depsgraph_get())[0].params()
    show_grid(person, box_grid(0.05, (-0.1, -0.1, 0.2), (0.1, 0.1, 0.4), 10.0, (0.5, 0.5, 0.5)), tmp_path)
    set_representation(person, mode)
    bpy.context.view_layer.update()
    graph = bpy.context.evaluated_depsgraph_get()
    assert [one.params() for one in posed_humans(graph)] == [expected]
    assert len(scene_solids(graph).corners) == 0
