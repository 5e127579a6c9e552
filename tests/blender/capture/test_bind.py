"""Surfaces without a skeleton: bound to the body in their parameters' pose, brought to rest, and posed anew."""

from pathlib import Path

import bpy
import numpy as np
import pytest
import scan_fixtures
from blender_primdiffusion.files.regular_files import FileError
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.rotation import about_axis, from_axis_angle, to_axis_angle
from loaded_scans import BETAS, BODY, MOVE, ROTATIONS, distance_m, load
from support.errors import refused

from blender_primdiffusion.capture.bind import join_surface, surface_weights, unpose
from blender_primdiffusion.capture.body import skin

SCANNED = scan_fixtures.a_pose() @ from_axis_angle(np.random.default_rng(5).normal(0, 0.12, (24, 3)))
PLACE = np.array([0.4, 1.1, 0.3])


def write_parameters(path: Path, **changes: object) -> None:
    theta = to_axis_angle(SCANNED)
    arrays = {
        "global_orient": theta[:1], "body_pose": theta[1:].reshape(1, 69), "betas": BETAS[None], "transl": PLACE[None],
    }  # fmt: skip
    np.savez(path, **{key: value for key, value in (arrays | changes).items() if value is not None})


def write_scan(path: Path, matrix: np.ndarray | None = None, **parameters: object) -> Path:
    """The posed body without bones, its points moved by `matrix` [3, 3], and its parameters beside it."""
    vertices = BODY.pose(BETAS, SCANNED, PLACE)[0]
    scan_fixtures.static(BODY, vertices if matrix is None else vertices @ matrix.T)
    scan_fixtures.save(path)
    write_parameters(path.with_suffix(".npz"), **parameters)
    return path


def assert_posed_as_the_body(scan) -> None:
    np.testing.assert_allclose(scan.betas, BETAS)
    joints = scan.pose(ROTATIONS, MOVE)
    vertices, expected, _ = BODY.pose(BETAS, ROTATIONS, MOVE)
    np.testing.assert_allclose(joints, expected, atol=5e-5)
    off = distance_m(scan, vertices)
    assert off.mean() < 0.001
    assert off.max() < 0.015


@pytest.mark.parametrize("ending", [".obj", ".glb", ".fbx"])
def test_a_static_scan_is_posed_as_the_body_is(tmp_path, empty_scene, ending):
    assert_posed_as_the_body(load(write_scan(tmp_path / f"anna{ending}")))


@pytest.mark.any_blender
@pytest.mark.parametrize(
    ("ending", "matrix", "note"),
    [
        (".obj", np.eye(3) * 100, "scaled by 0.01: its unit seems to be centimetres"),
        (".obj", about_axis(0, np.pi / 2), "turned to meet its parameters: their y is its z"),
        (".glb", np.eye(3) * 0.1, "scaled by 10: it is ten times too small"),
    ],
)
def test_other_units_and_axes_are_corrected_and_reported(tmp_path, empty_scene, ending, matrix, note):
    scan = load(write_scan(tmp_path / f"anna{ending}", matrix))
    assert note in scan.notes
    assert_posed_as_the_body(scan)


@pytest.mark.any_blender
def test_betas_of_another_body_give_way_to_those_of_the_surface(tmp_path, empty_scene):
    scan = load(write_scan(tmp_path / "anna.glb", betas=np.full((1, 10), 0.5)))
    assert any("shape of the default body fitted to its surface" in note for note in scan.notes)
    vertices, expected, _ = BODY.pose(BETAS, ROTATIONS, MOVE)
    assert np.linalg.norm(scan.pose(ROTATIONS, MOVE) - expected, axis=-1).max() < 0.02
    assert distance_m(scan, vertices).mean() < 0.004


@pytest.mark.any_blender
def test_a_scan_elsewhere_than_its_parameters_is_moved_and_that_is_reported(tmp_path, empty_scene):
    scan = load(write_scan(tmp_path / "anna.obj", transl=np.array([[5.0, 0, 0]])))
    assert any(note.startswith("moved by") for note in scan.notes)
    expected = BODY.pose(BETAS, ROTATIONS, MOVE)[1]
    assert np.linalg.norm(scan.pose(ROTATIONS, MOVE) - expected, axis=-1).max() < 0.01


@pytest.mark.any_blender
def test_an_arm_beside_the_trunk_stays_an_arm():
    rotations = np.tile(np.eye(3), (24, 1, 1))
    for side, sign in (("left", 1), ("right", -1)):
        rotations[JOINT_NAMES.index(f"{side}_shoulder")] = about_axis(2, -sign * np.radians(84))
    posed, _, skinning = BODY.pose(np.zeros(10), rotations, np.zeros(3))
    surface = join_surface(posed, BODY.faces)
    weights, _ = surface_weights(surface, posed, BODY)
    rest = unpose(surface.points, weights, skinning)[surface.point_of]
    off = np.linalg.norm(rest - BODY.template, axis=-1)
    assert np.quantile(off, 0.99) < 0.01
    forearm = BODY.skin_weights[:, JOINT_NAMES.index("left_elbow")] > 0.9
    assert off[forearm].max() < 0.02


@pytest.mark.any_blender
def test_unposing_undoes_posing():
    vertices, _, skinning = BODY.pose(BETAS, ROTATIONS, MOVE)
    rest, _ = BODY.rest(BETAS)
    back = unpose(vertices, BODY.skin_weights, skinning)
    np.testing.assert_allclose(skin(back, BODY.skin_weights, skinning), vertices, atol=1e-3)
    assert np.quantile(np.linalg.norm(back - rest, axis=-1), 0.99) < 1e-6


@pytest.mark.any_blender
def test_vertices_in_one_place_move_as_one():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1, 0, 0], [0, 0, 1]])
    surface = join_surface(points, np.array([[0, 1, 2], [3, 5, 4]]))
    assert len(surface.points) == 4
    assert surface.point_of[0] == surface.point_of[3]


@pytest.mark.any_blender
def test_loose_cloth_takes_the_weights_of_what_it_hangs_on(tmp_path, empty_scene):
    """A skirt far from the legs, one sheet with the waist: no part of it stays behind."""
    body_vertices = BODY.pose(BETAS, np.tile(np.eye(3), (24, 1, 1)), np.zeros(3))[0]
    angle, down = np.meshgrid(np.linspace(0, 2 * np.pi, 40, endpoint=False), np.linspace(0, 1, 20))
    radius = 0.16 + 0.3 * down
    skirt = np.stack([radius * np.sin(angle), -0.2 - 0.5 * down, radius * np.cos(angle)], -1).reshape(-1, 3)
    row, column = (grid.ravel() for grid in np.mgrid[:19, :40])
    a, b = row * 40 + column, row * 40 + (column + 1) % 40
    faces = np.concatenate([np.stack([a, b, a + 40], -1), np.stack([b, b + 40, a + 40], -1)])
    surface = join_surface(skirt, faces)
    weights, trust = surface_weights(surface, body_vertices, BODY)
    assert trust.min() < 0.2
    assert np.isfinite(weights).all()
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-9)
    steps = np.abs(weights[surface.neighbours[:, 0]] - weights[surface.neighbours[:, 1]]).sum(1)
    assert steps.max() < 0.8  # of 2, from one joint to another


@pytest.mark.any_blender
def test_a_scan_without_parameters_is_named(tmp_path, empty_scene):
    path = write_scan(tmp_path / "anna.obj")
    path.with_suffix(".npz").rename(tmp_path / "other.txt")
    with refused(FileError, "SMPL", "anna.npz"):
        load(path)
    path.with_suffix(".pkl").write_bytes(b"")
    with refused(FileError):
        load(path)
    assert len(bpy.data.objects) == 0


@pytest.mark.any_blender
@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"body_pose": None, "global_orient": None}, "pose"),
        ({"body_pose": np.full((1, 69), np.nan)}, "NaN"),
        ({"betas": np.full((1, 10), np.inf)}, "'betas'"),
        ({"betas": np.full((1, 10), 1e300)}, "'betas'"),
        ({"betas": np.array([{"a": 1}], object)}, "pickled"),
        ({"scale": np.array(0.0)}, "'scale'"),
        ({"body_pose": np.zeros((1, 30))}, "11 joints"),
    ],
)
def test_parameters_that_are_none_are_named(tmp_path, empty_scene, changes, name):
    path = write_scan(tmp_path / "anna.obj", **changes)
    with refused(FileError, name):
        load(path)
    assert len(bpy.data.objects) == 0


@pytest.mark.any_blender
def test_parameters_of_another_scan_are_named(tmp_path, empty_scene):
    lying = from_axis_angle(np.random.default_rng(9).normal(0, 1.2, (24, 3)))
    path = write_scan(tmp_path / "anna.obj", body_pose=to_axis_angle(lying)[1:].reshape(1, 69))
    with refused(FileError):
        load(path)


@pytest.mark.any_blender
def test_a_scale_in_the_parameters_is_taken_into_account(tmp_path, empty_scene):
    vertices = BODY.pose(BETAS, SCANNED, np.zeros(3))[0] * 0.6 + PLACE
    scan_fixtures.static(BODY, vertices)
    path = scan_fixtures.save(tmp_path / "anna.obj")
    write_parameters(path.with_suffix(".npz"), scale=np.array([0.6]))
    scan = load(path)
    np.testing.assert_allclose(scan.pose(ROTATIONS, MOVE), BODY.pose(BETAS, ROTATIONS, MOVE)[1], atol=5e-5)


@pytest.mark.any_blender
def test_a_broken_surface_still_works(tmp_path, empty_scene):
    """Holes, a doubled face, a face on edge of three others, loose points, two parts, no texture coordinates."""
    vertices = BODY.pose(BETAS, SCANNED, PLACE)[0]
    faces = np.concatenate([BODY.faces[::2], BODY.faces[:50], [[0, 1, 500], [0, 1, 700], [0, 1, 900]]])
    for name, part in (("a", faces[: len(faces) // 2]), ("b", faces[len(faces) // 2 :])):
        mesh = bpy.data.meshes.new(name)
        mesh.from_pydata((vertices @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])).tolist(), [], part.tolist())
        bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, mesh))
    path = scan_fixtures.save(tmp_path / "anna.glb")
    write_parameters(path.with_suffix(".npz"))
    scan = load(path)
    scan.pose(ROTATIONS, MOVE)
    assert distance_m(scan, BODY.pose(BETAS, ROTATIONS, MOVE)[0]).mean() < 0.003
    assert any("no texture coordinates" in note for note in scan.notes)
