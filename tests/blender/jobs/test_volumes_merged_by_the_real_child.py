"""Merging and the gain from the operator to what is shown, with the real child and a person of a small model."""

from pathlib import Path

import bpy
import numpy as np
import pytest
from human_files import sequence_files, volume_path
from oracle import evaluated_matrices

from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.human import humans
from blender_primdiffusion.scene.merged import merged_of
from blender_primdiffusion.scene.representation import representation_of, set_representation

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
ops = bpy.ops.primdiffusion


@pytest.fixture
def person(real_child):
    real_child.scene.primdiffusion.steps = 2
    ops.generate(seed=1)
    return humans(real_child.scene)[0]


def filled_box(path: Path) -> np.ndarray:
    """Lowest and highest corner [2, 3] of what is not empty, metres in the armature's space."""
    import openvdb

    grid = openvdb.read(str(path), "density")
    low, high = grid.evalActiveVoxelBoundingBox()
    return np.array([grid.transform.indexToWorld(corner) for corner in (low, high)])


def test_a_merged_person_fills_the_space_of_the_volumes_on_the_surface(person):
    turns = np.tile(np.eye(3), (24, 1, 1))
    turns[16] = [[np.cos(1.2), np.sin(1.2), 0], [-np.sin(1.2), np.cos(1.2), 0], [0, 0, 1]]
    pose_from_joint_rotations(person, turns)
    bpy.context.scene.primdiffusion_merging.voxel = 0.02
    assert ops.merge() == {"FINISHED"}
    box = filled_box(volume_path(merged_of(person).data))
    set_representation(person, "VOLUMES")
    places_of = evaluated_matrices(person)[:, :3, 3] - np.array(person.matrix_world)[:3, 3]
    assert len(places_of) == 1024
    centres = np.array([np.min(places_of, 0), np.max(places_of, 0)])
    assert (box[0] < centres[0] + 0.02).all()
    assert (box[1] > centres[1] - 0.02).all()
    np.testing.assert_allclose(box, centres, atol=0.15)


def test_frames_come_from_the_child(person):
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end, scene.primdiffusion_merging.voxel = 1, 3, 0.03
    ops.merge(what="FRAMES")
    assert representation_of(person) == "MERGED"
    assert len(sequence_files(merged_of(person).data)) == 3


def test_voxels_too_small_for_the_machine_are_rejected_with_a_size_to_choose(person):
    bpy.context.scene.primdiffusion_merging.voxel = 0.0005
    with pytest.raises(RuntimeError, match=r"choose .* mm or more"):
        ops.merge()
    assert merged_of(person) is None
