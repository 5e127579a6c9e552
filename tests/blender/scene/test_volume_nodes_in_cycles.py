"""What Cycles shows: colours and opacity of the volumes, where the marcher's conventions put them."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
import synthetic
import synthetic_shape
from scene_stage import render
from support.errors import refused

from benchmarks.cycles_preview import setup_cycles_preview
from blender_primdiffusion.engine.picture import posed_humans, scene_solids
from blender_primdiffusion.scene.armature import model_origin, pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.merged import MergedGrid, MergedState, merged_folder, publish, show_merged, write_grid
from blender_primdiffusion.scene.place import posed_extent
from blender_primdiffusion.scene.representation import set_representation
from blender_primdiffusion.scene.volume_nodes import GAIN_NODE, MATERIAL_NAME, write_volumes

RED = (0.6, 0.1, 0.05)
DENSITY = 20.0
HALF = np.array([0.05, 0.07, 0.06])


@pytest.fixture
def lone_box(saved_scene, tmp_path):
    """A person of one box along the axes at chest height, red, denser in its left half (the person's left, +x)."""
    density = np.full((1, 8, 8, 8), DENSITY, np.float32)
    density[..., :4] *= 0.25  # the last axis, W, runs along T = +x: the person's right half
    arrays = synthetic.arrays(1)
    model = {
        "face": np.array([0]),
        "faces": np.array([[0, 1, 2]]),
        "barycentric": np.full((1, 3), 1 / 3),
        "stencil_vertex": np.array([[0, 1, 2, 0, 0]]),
        "stencil_du": np.array([[-1.0, 1, 0, 0, 0]]),
        "stencil_dv": np.array([[-1.0, 0, 1, 0, 0]]),
        "template": np.array([[-0.1, 0.2, 0], [0.2, 0.2, 0], [-0.1, 0.5, 0], *arrays["template"][3:]]),
        "skin_weights": np.tile(np.eye(24)[9], (len(arrays["template"]), 1)),
        "uv_corner": np.zeros((1, 3, 2)),
        "half_extent": HALF[None],
        "rest_half_extent": HALF[None],
        "rgb": np.broadcast_to(np.float16(RED), (1, 8, 8, 8, 3)),
        "density": density,
    }
    person = synthetic.save(tmp_path / "human", {**arrays, **model})
    human = build_human(saved_scene, person)
    write_volumes(human)
    return human


def test_a_box_has_its_colour_opacity_size_and_place_in_cycles(lone_box, tmp_path):
    camera = setup_cycles_preview(bpy.context.scene, size=96, samples=4)
    camera.data.type, camera.data.ortho_scale = "ORTHO", 0.24
    armature = lone_box
    centre = np.array([0, 0, 0.3]) + np.array(armature.location) + model_origin(armature.data)
    camera.location = (0, -3, centre[2])
    gain = bpy.data.materials[MATERIAL_NAME].node_tree.nodes[GAIN_NODE].outputs[0]
    gain.default_value = 1.0
    picture = render(tmp_path / "box.exr")
    alpha, metres = picture[..., 3], 0.24 / 96
    opaque = alpha > 0.2
    np.testing.assert_allclose(
        picture[..., :3][opaque] / alpha[opaque][:, None], np.broadcast_to(RED, (opaque.sum(), 3)), atol=5e-3
    )

    depth = -np.log(1 - alpha)
    mass = depth.sum() * metres**2
    axis = np.exp(-8 * np.abs(np.linspace(-1, 1, 8)) ** 8)
    weights = np.where(np.arange(8) < 4, 0.25, 1.0) * axis
    voxel = np.prod(2 * HALF / 7)
    assert mass == pytest.approx(DENSITY * weights.sum() * axis.sum() ** 2 * voxel, rel=0.03)

    columns = (np.arange(96) + 0.5 - 48) * metres
    expected_x = (weights * np.linspace(-HALF[0], HALF[0], 8)).sum() / weights.sum()
    # a wrong half voxel would be 7 to 10 mm
    seen_x, seen_z = (depth * columns).sum() / depth.sum(), (depth * -columns[:, None]).sum() / depth.sum()
    assert expected_x > 0.01  # the dense half is on the right of the picture: not mirrored
    assert seen_x == pytest.approx(expected_x, abs=1.5e-3)
    assert seen_z == pytest.approx(0.0, abs=1.5e-3)


def test_the_camera_frames_a_posed_person_from_every_side(saved_scene, tmp_path):
    person = build_human(saved_scene, synthetic.write(tmp_path / "human", 8))
    pose_from_joint_rotations(person, synthetic.random_rotations(np.random.default_rng(0), 24), np.ones(3))
    person.location.x += 5
    from bpy_extras.object_utils import world_to_camera_view

    for yaw in (0.0, 0.7, np.pi / 2, 3.0):
        camera = setup_cycles_preview(bpy.context.scene, yaw=yaw)
        bpy.context.view_layer.update()
        low, high = posed_extent(person)
        matrix = person.matrix_world
        seen = [world_to_camera_view(bpy.context.scene, camera, matrix @ bone.head) for bone in person.pose.bones]
        assert all(0 < point.x < 1 and 0 < point.y < 1 and point.z > 0 for point in seen)
        span = max(np.ptp([point.x for point in seen]), np.ptp([point.y for point in seen]))
        assert span > 0.4
        assert (high > low).all()


@pytest.mark.any_blender
def test_an_empty_scene_has_no_human_to_frame(empty_scene):
    with refused(ValueError, "human"):
        setup_cycles_preview(bpy.context.scene)


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
