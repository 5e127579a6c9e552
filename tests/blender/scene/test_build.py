"""The whole person in the scene: follows linear blend skinning, survives saving, undo and removal, fails cleanly."""

from __future__ import annotations

import itertools
import json

import bpy
import numpy as np
import pytest
import synthetic
from human_files import folder_of
from human_stage import strong_pose
from mathutils import Matrix, Vector
from oracle import TOLERANCE_M, evaluated_matrices, raised, surface_frames, world_from_model
from support.errors import refused

from blender_primdiffusion.scene import volume_nodes
from blender_primdiffusion.scene.armature import keyframe_poses, pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.convention import points_to_blender
from blender_primdiffusion.scene.human import MARK, body_of, humans, parts_of

KINDS = ("objects", "collections", "volumes", "meshes", "armatures", "materials", "actions", "images", "node_groups")


def datablocks() -> dict[str, list[str]]:
    return {kind: sorted(obj.name for obj in getattr(bpy.data, kind)) for kind in KINDS}


@pytest.fixture
def person(saved_scene, tmp_path):
    """The synthetic person in shot.blend, as (collection, arrays)."""
    return build_human(saved_scene, synthetic.write(tmp_path / "human", 48)), synthetic.arrays(48)


def expected_matrices(collection, arrays, rotations, translation) -> np.ndarray:
    bpy.context.view_layer.update()
    return world_from_model(collection, arrays["vertices"]) @ surface_frames(arrays, rotations, translation)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.any_blender)])
def test_volumes_follow_the_skin_to_a_hundredth_of_a_millimetre(person, seed):
    collection, arrays = person
    rotations, translation = strong_pose(seed)
    armature = collection
    pose_from_joint_rotations(armature, rotations, translation)
    armature.location, armature.rotation_euler, armature.scale = (1, -2, 0.5), (0.4, -0.3, 2.0), (1.2, 1.2, 1.2)
    expected = expected_matrices(collection, arrays, rotations, translation)
    corners = np.array([[x, y, z, 1] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (-0.05, 0.05)])
    error = np.abs((evaluated_matrices(collection) - expected) @ corners.T)[:, :3].max()
    assert error < TOLERANCE_M


def test_1024_volumes_follow_a_keyframed_walk(saved_scene, tmp_path):
    arrays = synthetic.arrays(1024)
    collection = build_human(saved_scene, synthetic.write(tmp_path / "human", 1024))
    assert len(parts_of(collection)) == 3
    assert len(evaluated_matrices(collection)) == len(list(folder_of(collection).glob("prim_*.vdb"))) == 1024
    frames = np.arange(1, 9)
    swing = np.zeros((8, 24, 3))
    swing[:, 1, 0], swing[:, 2, 0] = 0.5 * np.sin(frames), -0.5 * np.sin(frames)
    swing[:, 18, 1], swing[:, 16, 2] = 0.8 * np.cos(frames), -1.0
    rotations, translations = synthetic.axis_angle(swing), np.stack([0 * frames, 0 * frames, 0.1 * frames], -1)
    keyframe_poses(collection, frames, rotations, translations)
    for index in (0, 3, 7):
        bpy.context.scene.frame_set(int(frames[index]))
        expected = expected_matrices(collection, arrays, rotations[index], translations[index])
        np.testing.assert_allclose(evaluated_matrices(collection)[:, :3, 3], expected[:, :3, 3], atol=TOLERANCE_M)
        axes = np.abs(evaluated_matrices(collection) - expected)[:, :3, :3].max((1, 2))
        assert np.quantile(axes, 0.98) < 1e-4, "random tangent planes may be nearly degenerate"


def test_soles_stand_on_the_floor_and_the_person_faces_minus_y(person):
    collection, arrays = person
    armature = collection
    assert armature.matrix_world.translation.length == 0, "the origin is on the floor"
    feet = [vertex.co for vertex in body_of(collection).data.vertices]
    assert min(point.z for point in feet) == pytest.approx(0, abs=1e-6)
    bones = armature.data.bones
    model = points_to_blender(arrays["joints"]) - [0, 0, points_to_blender(arrays["vertices"])[:, 2].min()]
    np.testing.assert_allclose([bones[name].head_local for name in synthetic.NAMES], model, atol=1e-6)
    assert bones["left_foot"].head_local.y < bones["left_ankle"].head_local.y
    assert bones["left_hip"].head_local.x > 0


def test_a_volume_covers_its_box_in_the_world(person):
    collection, arrays = person
    matrix = evaluated_matrices(collection)[7]
    volume = bpy.data.volumes.new("read")
    volume.filepath = str(folder_of(collection) / "prim_0007.vdb")
    read = bpy.data.objects.new("read", volume)
    bpy.context.scene.collection.objects.link(read)
    bpy.context.view_layer.update()
    box = read.evaluated_get(bpy.context.evaluated_depsgraph_get()).bound_box
    corners = np.array([Matrix(matrix) @ Vector(corner) for corner in box])
    half = arrays["half_extent"][7]
    edge = half * 8 / 7  # half a voxel beyond the centres of the outermost
    local = np.array(list(itertools.product(*[(-e, e) for e in edge])))
    box = surface_frames(arrays, np.tile(np.eye(3), (24, 1, 1)), np.zeros(3))[7]
    expected = local @ box[:3, :3].T + box[:3, 3] + raised(arrays["vertices"])[:3, 3]
    np.testing.assert_allclose(sorted(corners.tolist()), sorted(expected.tolist()), atol=1e-5)


def test_one_material_serves_all_people(person, saved_scene, tmp_path):
    build_human(saved_scene, synthetic.write(tmp_path / "second", 8, seed=1))
    assert len(bpy.data.materials) == 1
    assert len(humans(bpy.context.scene)) == 2


@pytest.mark.any_blender
def test_provenance_is_stored_on_the_armature(person):
    collection, arrays = person
    stored = json.loads(collection[MARK])
    assert stored["seed"] == 0
    np.testing.assert_allclose(stored["betas"], arrays["betas"], atol=1e-6)


@pytest.mark.any_blender
@pytest.mark.parametrize("damage", ["truncated", "NaN"])
def test_a_corrupted_file_leaves_scene_and_disk_as_they_were(saved_scene, tmp_path, damage):
    path = synthetic.write(tmp_path / "human", 8)
    if damage == "truncated":
        path.write_bytes(path.read_bytes()[:5000])
    else:
        synthetic.write(path.parent, 8, density=np.full((8, 8, 8, 8), np.nan, np.float32))
    files = sorted(tmp_path.rglob("*"))
    with refused(ValueError, path.name):
        build_human(saved_scene, path)
    assert not any(datablocks().values())
    assert sorted(tmp_path.rglob("*")) == files


@pytest.mark.any_blender
def test_a_failure_in_the_middle_of_building_leaves_the_scene_as_it_was(person, saved_scene, tmp_path, monkeypatch):
    before = datablocks()

    def failing(*_):
        raise MemoryError("no memory for the volumes")

    monkeypatch.setattr(volume_nodes, "add_nodes", failing)
    with pytest.raises(MemoryError):
        build_human(saved_scene, synthetic.write(tmp_path / "second", 8, seed=3))
    assert datablocks() == before


def test_building_from_edit_mode_works(saved_scene, tmp_path):
    mesh = bpy.data.objects.new("cube", bpy.data.meshes.new("cube"))
    saved_scene.scene.collection.objects.link(mesh)
    saved_scene.view_layer.objects.active = mesh
    bpy.ops.object.mode_set(mode="EDIT")
    collection = build_human(saved_scene, synthetic.write(tmp_path / "human", 8))
    assert collection.mode == "OBJECT"
