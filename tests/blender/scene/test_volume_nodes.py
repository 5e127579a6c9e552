"""Volumes as one object of nodes: the paper's frames, a file for each primitive, undo, saving, copies, refusals."""

import sys

import bpy
import numpy as np
import pytest
import synthetic_shape
from human_files import folder_of, paths_of
from human_stage import strong_pose
from oracle import evaluated_matrices, surface_frames, world_from_model
from support.errors import refused

from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import body_of, humans
from blender_primdiffusion.scene.representation import representation_of, set_representation, show_in_viewport
from blender_primdiffusion.scene.volume_nodes import (
    GROUP_NAME,
    are_written,
    open_humans,
    set_folder,
    volumes_of,
    write_volumes,
)

COUNT = 12
AT_REST = np.tile(np.eye(3), (24, 1, 1)), np.zeros(3)


@pytest.fixture
def person(saved_scene, tmp_path):
    """A synthetic person of format version 2 in shot.blend, as (human, arrays)."""
    arrays = synthetic_shape.arrays(COUNT)
    return build_human(saved_scene, synthetic_shape.write(tmp_path / "human", COUNT)), arrays


def expected(human, arrays, rotations, translation) -> np.ndarray:
    bpy.context.view_layer.update()
    return world_from_model(human, arrays["vertices"]) @ surface_frames(arrays, rotations, translation)


def drawn() -> int:
    """Volumes that the viewport shows."""
    bpy.context.view_layer.update()
    return sum(one.object.type == "VOLUME" for one in bpy.context.evaluated_depsgraph_get().object_instances)


def test_each_volume_shows_the_file_of_its_primitive(person):
    human, _ = person
    write_volumes(human)
    paths_of(human)[4].unlink()
    show_in_viewport(human, True)
    assert drawn() == COUNT - 1


def test_nothing_is_written_or_read_until_it_is_to_be_seen(person):
    human, _ = person
    assert volumes_of(human).hide_viewport
    assert not volumes_of(human).hide_render
    assert drawn() == 0
    assert not list(folder_of(human).glob("*.vdb"))
    show_in_viewport(human, True)
    assert drawn() == 0
    write_volumes(human)
    set_folder(human, folder_of(human), again=True)
    assert drawn() == COUNT, "Blender has looked for the files before they were there"


def test_saving_and_loading_keeps_frames_and_representation(person):
    human, arrays = person
    pose = strong_pose(0)
    pose_from_joint_rotations(human, *pose)
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert open_humans() == []
    (human,) = humans(bpy.context.scene)
    assert representation_of(human) == "VOLUMES"
    np.testing.assert_allclose(evaluated_matrices(human), expected(human, arrays, *pose), atol=3e-5)


def test_posing_opens_and_changes_no_file(person):
    human, _ = person
    evaluated_matrices(human)
    show_in_viewport(human, True)
    assert drawn() == COUNT
    files = {path: path.stat().st_mtime_ns for path in folder_of(human).iterdir()}
    opened = []
    sys.addaudithook(lambda event, arguments: opened.append(arguments[0]) if event == "open" else None)
    pose_from_joint_rotations(human, *strong_pose(3))
    assert drawn() == COUNT
    assert not [path for path in opened if str(path).endswith((".vdb", ".safetensors"))]
    assert {path: path.stat().st_mtime_ns for path in folder_of(human).iterdir()} == files


def test_two_people_share_the_nodes_and_keep_to_their_own_bodies(person, tmp_path):
    human, arrays = person
    other = build_human(bpy.context, synthetic_shape.write(tmp_path / "second", COUNT, seed=5), "Second")
    assert sum(group.name.startswith(GROUP_NAME) for group in bpy.data.node_groups) == 1
    pose_from_joint_rotations(other, *strong_pose(1))
    np.testing.assert_allclose(evaluated_matrices(human), expected(human, arrays, *AT_REST), atol=1e-5)
    found = evaluated_matrices(other)
    wanted = expected(other, synthetic_shape.arrays(COUNT, 5), *strong_pose(1))
    np.testing.assert_allclose(found, wanted, atol=3e-5)


def test_deleted_volumes_are_made_again_when_they_are_asked_for(person):
    human, arrays = person
    bpy.data.objects.remove(volumes_of(human))
    set_representation(human, "VOLUMES")
    np.testing.assert_allclose(evaluated_matrices(human), expected(human, arrays, *AT_REST), atol=1e-5)
    assert are_written(human)


@pytest.mark.any_blender
def test_a_deleted_body_is_rejected_with_what_to_do(person):
    bpy.data.objects.remove(body_of(person[0]))
    bpy.data.objects.remove(volumes_of(person[0]))
    with refused(ValueError, "deleted"):
        set_representation(person[0], "VOLUMES")


@pytest.mark.any_blender
def test_unknown_representations_and_what_is_not_merged_are_rejected(person):
    with refused(ValueError, "VOLUMES", "MERGED", "SPLATS"):
        set_representation(person[0], "BONES")
    with refused(ValueError, "Merge"):
        set_representation(person[0], "MERGED")
    assert representation_of(person[0]) == "VOLUMES"
