"""Attachment to the surface and switching modes: the paper's frames, undo, saving, deletion, refusals."""

from __future__ import annotations

import sys

import bpy
import numpy as np
import pytest
import synthetic
import synthetic_shape
from blender_primdiffusion.scene.attachment import IN_VIEWPORT, attachment_of, set_attachment
from blender_primdiffusion.scene.surface import GROUP_NAME, carrier_of, primitives_of
from human_files import copy_of, folder_of
from human_stage import strong_pose
from oracle import Z_UP, blended_frames, blended_vertices, evaluated_matrices, world_from_model
from support.errors import refused

from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.human import body_of, humans, volumes_of

pytestmark = pytest.mark.usefixtures("volumes_shown")

COUNT = 12


@pytest.fixture
def person(saved_scene, tmp_path):
    """A synthetic person of format version 2 in shot.blend, as (collection, arrays)."""
    arrays = synthetic_shape.arrays(COUNT)
    return build_human(saved_scene, synthetic_shape.write(tmp_path / "human", COUNT)), arrays


def shown() -> dict[str, np.ndarray]:
    """World matrices [4, 4] of the volumes that are drawn, by the names of their objects; each must be drawn once."""
    bpy.context.view_layer.update()
    found: dict[str, np.ndarray] = {}
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        if instance.object.type == "VOLUME" and instance.show_self:
            assert instance.object.original.name not in found
            found[instance.object.original.name] = np.array(instance.matrix_world)
    return found


def on_the_surface(collection, arrays, rotations, translation) -> np.ndarray:
    """Where the paper has the primitives [K, 4, 4] in the world: frames of the posed surface, by definition."""
    vertices = blended_vertices(arrays, rotations, translation) @ Z_UP[:3, :3]  # the oracle's z up to y up again
    position, rotation = synthetic.frames(vertices, arrays)
    frames = np.tile(np.eye(4), (len(position), 1, 1))
    frames[:, :3, :3], frames[:, :3, 3] = rotation, position
    return world_from_model(collection, arrays["vertices"]) @ Z_UP @ frames


def degrees_apart(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Angles between the axes of matrices [K, 4, 4], whatever their scale."""
    axes = [m[:, :3, :3] / np.cbrt(np.linalg.det(m[:, :3, :3]))[:, None, None] for m in (one, other)]
    return np.degrees(2 * np.arcsin(np.minimum(np.linalg.norm(axes[0] - axes[1], axis=(1, 2)) / np.sqrt(8), 1)))


@pytest.mark.parametrize("seed", range(3))
def test_volumes_lie_on_the_posed_surface_s_tangent_planes(person, seed):
    collection, arrays = person
    rotations, translation = strong_pose(seed)
    armature = collection
    pose_from_joint_rotations(armature, rotations, translation)
    armature.location, armature.rotation_euler, armature.scale = (1, -2, 0.5), (0.4, -0.3, 2.0), (1.2, 1.2, 1.2)
    set_attachment(collection, "SURFACE")
    found = shown()
    matrices = np.array([found[name] for name in sorted(found)])
    expected = on_the_surface(collection, arrays, rotations, translation)
    assert len(matrices) == COUNT
    assert np.abs(matrices[:, :3, 3] - expected[:, :3, 3]).max() < 1e-5
    assert degrees_apart(matrices, expected).max() < 0.1
    np.testing.assert_allclose(np.cbrt(np.linalg.det(matrices[:, :3, :3])), 1.2, rtol=1e-5)


def test_modes_differ_in_a_strong_pose_and_agree_at_rest(person):
    collection, _ = person
    by_armature = shown()
    set_attachment(collection, "SURFACE")
    on_surface = shown()
    assert set(by_armature) == set(on_surface)
    for name, matrix in by_armature.items():
        np.testing.assert_allclose(on_surface[name], matrix, atol=2e-5)
    pose_from_joint_rotations(collection, *strong_pose(1))
    posed = shown()
    set_attachment(collection, "ARMATURE")
    names = sorted(posed)
    assert degrees_apart(*(np.array([where[name] for name in names]) for where in (posed, shown()))).max() > 2


def test_back_by_the_armature_volumes_follow_linear_blend_skinning_again(person):
    collection, arrays = person
    rotations, translation = strong_pose(2)
    pose_from_joint_rotations(collection, rotations, translation)
    set_attachment(collection, "SURFACE")
    set_attachment(collection, "ARMATURE")
    assert len(shown()) == COUNT
    world = world_from_model(collection, arrays["vertices"])
    expected = world @ blended_frames(arrays, rotations, translation)
    assert np.abs(evaluated_matrices(collection) - expected).max() < 2e-5
    assert carrier_of(collection).hide_render
    assert carrier_of(collection).hide_viewport


def test_saving_and_loading_keeps_the_surface_s_frames(person):
    collection, arrays = person
    rotations, translation = strong_pose(0)
    pose_from_joint_rotations(collection, rotations, translation)
    set_attachment(collection, "SURFACE")
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    collection = humans(bpy.context.scene)[0]
    assert attachment_of(collection) == "SURFACE"
    found = shown()
    expected = on_the_surface(collection, arrays, rotations, translation)
    np.testing.assert_allclose(
        np.array([found[name] for name in sorted(found)])[:, :3, 3], expected[:, :3, 3], atol=1e-5
    )


def test_undo_goes_back_to_the_armature_and_redo_to_the_surface(person):
    bpy.ops.ed.undo_push(message="before")
    set_attachment(person[0], "SURFACE")
    bpy.ops.ed.undo_push(message="after")
    bpy.ops.ed.undo()
    assert attachment_of(humans(bpy.context.scene)[0]) == "ARMATURE"
    assert len(shown()) == COUNT
    bpy.ops.ed.redo()
    assert attachment_of(humans(bpy.context.scene)[0]) == "SURFACE"
    assert len(shown()) == COUNT


def test_posing_opens_and_changes_no_file(person):
    collection, _ = person
    files = {path: path.stat().st_mtime_ns for path in folder_of(collection).iterdir()}
    opened = []
    sys.addaudithook(lambda event, arguments: opened.append(arguments[0]) if event == "open" else None)
    for mode in ("SURFACE", "ARMATURE"):
        set_attachment(collection, mode)
        opened.clear()
        pose_from_joint_rotations(collection, *strong_pose(3))
        shown()
        assert not [path for path in opened if str(path).endswith((".vdb", ".npz"))]
    assert {path: path.stat().st_mtime_ns for path in folder_of(collection).iterdir()} == files


def test_a_deleted_and_a_renamed_volume_leave_the_others_where_they_are(person):
    collection, arrays = person
    volumes = volumes_of(collection)
    gone, renamed = volumes[3][0], volumes[5][0]
    bpy.data.objects.remove(gone)
    renamed.name = "Zz 10"
    volumes[6][0].name = "zz 9"
    rotations, translation = strong_pose(4)
    pose_from_joint_rotations(collection, rotations, translation)
    set_attachment(collection, "SURFACE")
    found = shown()
    assert len(found) == COUNT - 1
    expected = on_the_surface(collection, arrays, rotations, translation)
    for k, objects in volumes_of(collection).items():
        np.testing.assert_allclose(found[objects[0].name][:3, 3], expected[k, :3, 3], atol=1e-5)


def test_two_people_share_the_nodes_and_keep_to_their_own_bodies(person, tmp_path):
    other = build_human(bpy.context, synthetic_shape.write(tmp_path / "second", COUNT, seed=5), "Second")
    for collection in (person[0], other):
        set_attachment(collection, "SURFACE")
    assert len(shown()) == 2 * COUNT
    assert sum(group.name.startswith(GROUP_NAME) for group in bpy.data.node_groups) == 1
    pose_from_joint_rotations(other, *strong_pose(1))
    rest = on_the_surface(person[0], person[1], np.tile(np.eye(3), (24, 1, 1)), np.zeros(3))
    found = shown()
    own = [volume[0].name for _, volume in sorted(volumes_of(person[0]).items())]
    np.testing.assert_allclose(np.array([found[name] for name in own])[:, :3, 3], rest[:, :3, 3], atol=1e-5)


def test_a_duplicate_on_the_surface_follows_its_own_bones(person):
    collection, arrays = person
    set_attachment(collection, "SURFACE")
    twin = copy_of(collection)
    set_attachment(twin, "SURFACE")
    rotations, translation = strong_pose(1)
    pose_from_joint_rotations(twin, rotations, translation)
    found = shown()
    assert len(found) == 2 * COUNT
    for owner, turns, shift in (
        (twin, rotations, translation),
        (collection, np.tile(np.eye(3), (24, 1, 1)), np.zeros(3)),
    ):
        expected = on_the_surface(owner, arrays, turns, shift)
        for k, objects in volumes_of(owner).items():
            np.testing.assert_allclose(found[objects[0].name][:3, 3], expected[k, :3, 3], atol=1e-5)


def test_a_deleted_body_is_rejected_with_what_to_do(person):
    bpy.data.objects.remove(body_of(person[0]))
    with refused(ValueError, "deleted"):
        set_attachment(person[0], "SURFACE")
    assert len(shown()) == COUNT


def test_unknown_modes_and_what_is_not_merged_are_rejected(person):
    with refused(ValueError, "ARMATURE", "SURFACE", "MERGED"):
        set_attachment(person[0], "BONES")
    with refused(ValueError, "Merge"):
        set_attachment(person[0], "MERGED")
    assert attachment_of(person[0]) == "ARMATURE"


def test_a_human_of_an_earlier_version_stays_shown_in_viewports(person):
    collection, _ = person
    del collection[IN_VIEWPORT]
    set_attachment(collection, "SURFACE")
    set_attachment(collection, "ARMATURE")
    assert not primitives_of(collection).hide_viewport
