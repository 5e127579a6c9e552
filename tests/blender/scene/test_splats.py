"""Splats: where Blender's nodes put them on a posed body, by the oracles; edits, copies, undo, appending, removal."""

from __future__ import annotations

import math
from pathlib import Path

import bpy
import numpy as np
import pytest
import synthetic
import synthetic_shape
from human_stage import strong_pose
from oracle import Z_UP, blended_vertices, world_from_model

from blender_primdiffusion.engine.boxes import boxes_of
from blender_primdiffusion.engine.picture import posed_humans
from blender_primdiffusion.scene import build
from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.attachment import attachment_of, set_attachment
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.copies import duplicate_human, separate_copies
from blender_primdiffusion.scene.edit import reshape
from blender_primdiffusion.scene.human import armature_of, humans, remove_human, volume_path
from blender_primdiffusion.scene.pending import pending_volumes
from blender_primdiffusion.scene.splat_nodes import GROUP_NAME
from blender_primdiffusion.scene.splats import SPLATS_AVAILABLE, WIDTH, cells_in, splats_in
from blender_primdiffusion.scene.surface import set_node_input

pytestmark = [
    pytest.mark.usefixtures("splats"),
    pytest.mark.skipif(not SPLATS_AVAILABLE, reason="Gaussian splats came with Blender 5.3"),
]
COUNT = 12
FIELDS = {"position": ("vector", 3), "scale": ("vector", 3), "rotation": ("value", 4), "cell": ("value", 1)}


@pytest.fixture
def person(saved_scene, tmp_path):
    """A synthetic person in shot.blend, as (collection, arrays)."""
    return build_human(saved_scene, synthetic_shape.write(tmp_path / "human", COUNT)), synthetic_shape.arrays(COUNT)


def read(cloud, name) -> np.ndarray:
    field, width = FIELDS[name]
    values = np.empty((len(cloud.points), width), np.int32 if name == "cell" else np.float32)
    cloud.attributes[name].data.foreach_get(field, values.ravel())
    return values


def drawn(collection, name="position") -> np.ndarray:
    """What Blender draws of a human's splats, in the space of its armature."""
    bpy.context.view_layer.update()
    evaluated = splats_in(collection).evaluated_get(bpy.context.evaluated_depsgraph_get())
    assert evaluated.data.type == "GAUSSIAN_SPLAT"
    return read(evaluated.data, name)


def expected(collection, arrays, rotations, translation) -> np.ndarray:
    """Where the splats belong in the armature's space: on the frames of the posed surface, by definition."""
    vertices = blended_vertices(arrays, rotations, translation) @ Z_UP[:3, :3]
    position, rotation = synthetic.frames(vertices, arrays)
    frames = np.tile(np.eye(4), (len(position), 1, 1))
    frames[:, :3, :3], frames[:, :3, 3] = rotation, position
    armature = armature_of(collection)
    frames = world_from_model(armature, arrays["vertices"]) @ Z_UP @ frames
    frames = np.linalg.inv(np.array(armature.matrix_world)) @ frames
    cloud = splats_in(collection).data
    frames, local = frames[read(cloud, "cell")[:, 0]], read(cloud, "position")
    growth = arrays.get("growth", np.ones((COUNT, 3)))[read(cloud, "cell")[:, 0]]
    return np.einsum("nij,nj->ni", frames[:, :3, :3], local * growth) + frames[:, :3, 3]


@pytest.mark.parametrize("seed", [None, 1, 2])
def test_splats_lie_in_the_frames_of_the_posed_surface(person, seed):
    collection, arrays = person
    rotations, translation = (np.tile(np.eye(3), (24, 1, 1)), np.zeros(3)) if seed is None else strong_pose(seed)
    pose_from_joint_rotations(armature_of(collection), rotations, translation)
    np.testing.assert_allclose(drawn(collection), expected(collection, arrays, rotations, translation), atol=2e-5)


def test_splats_follow_a_new_shape_and_grow_with_it(person):
    collection, arrays = person
    betas = np.array([2.0, -1.0, 0, 0, 0, 0, 0, 0, 0, 0])
    before = drawn(collection, "scale")
    reshape(collection, betas)
    rotations, translation = strong_pose(3)
    pose_from_joint_rotations(armature_of(collection), rotations, translation)
    wanted = synthetic_shape.at(arrays, betas)
    np.testing.assert_allclose(drawn(collection), expected(collection, wanted, rotations, translation), atol=5e-5)
    cell = read(splats_in(collection).data, "cell")[:, 0]
    np.testing.assert_allclose(drawn(collection, "scale"), before * wanted["growth"][cell], rtol=1e-4)


def test_splats_of_the_sample_stretch_with_the_skin_as_the_engines_boxes_do(saved_scene):
    collection = build_human(saved_scene, Path(build.__file__).parents[1] / "gallery" / "Sample.human")
    armature = armature_of(collection)
    for bone, turn in (("left_hip", -1.5), ("left_knee", 1.2), ("right_shoulder", 0.6)):
        armature.pose.bones[bone].rotation_mode = "XYZ"
        armature.pose.bones[bone].rotation_euler[0] = turn
    cloud = splats_in(collection).data
    scale, cell = drawn(collection, "scale"), read(cloud, "cell")[:, 0]
    boxes = boxes_of(posed_humans(bpy.context.evaluated_depsgraph_get())[0])
    np.testing.assert_allclose(scale, boxes.half_extent[cell] * 2 / 7 * np.array(WIDTH), rtol=2e-3)
    assert (scale / read(cloud, "scale")).max() > 1.3
    stretch = scale / read(cloud, "scale")
    places = np.einsum("nij,nj->ni", boxes.rotation[cell], read(cloud, "position") * stretch) + boxes.position[cell]
    in_world = drawn(collection) @ np.array(armature.matrix_world)[:3, :3].T + np.array(armature.matrix_world)[:3, 3]
    np.testing.assert_allclose(in_world, np.stack([places[:, 0], -places[:, 2], places[:, 1]], -1), atol=2e-4)


def test_volumes_are_written_only_when_splats_no_longer_show_the_human(person):
    collection, _ = person
    volumes = [obj for obj in collection.all_objects if obj.type == "VOLUME"]
    assert attachment_of(collection) == "SPLATS"
    assert not any(volume_path(volume.data).exists() for volume in volumes)
    assert not pending_volumes()
    assert not splats_in(collection).hide_render
    set_attachment(collection, "ARMATURE")
    assert len(pending_volumes()) == 1
    assert splats_in(collection).hide_render
    set_attachment(collection, "SPLATS")
    assert not pending_volumes()
    assert not splats_in(collection).hide_viewport


@pytest.mark.parametrize("copying", ["duplicate_human", "Shift-D", "Alt-D"])
def test_copies_have_splats_of_their_own_that_share_their_data(person, copying):
    collection, arrays = person
    if copying == "duplicate_human":
        copy = duplicate_human(collection)
    else:
        bpy.ops.object.select_all(action="DESELECT")
        for obj in (armature_of(collection), *armature_of(collection).children):
            obj.select_set(True)
        bpy.ops.object.duplicate(linked=copying == "Alt-D")
        separate_copies()
        copy = next(human for human in humans(bpy.context.scene) if human != collection)
    still = drawn(collection)
    rotations, translation = strong_pose(4)
    pose_from_joint_rotations(armature_of(copy), rotations, translation)
    np.testing.assert_allclose(drawn(copy), expected(copy, arrays, rotations, translation), atol=2e-5)
    np.testing.assert_array_equal(drawn(collection), still)
    assert len([group for group in bpy.data.node_groups if group.name.startswith(GROUP_NAME)]) == 1
    if copying == "duplicate_human":
        assert splats_in(copy).data == splats_in(collection).data
    reshape(copy, np.array([3.0, 0, 0, 0, 0, 0, 0, 0, 0, 0]))
    np.testing.assert_array_equal(drawn(collection), still)


def test_undo_takes_a_new_shape_back(person):
    collection, _ = person
    bpy.ops.ed.undo_push(message="before")
    before, name = drawn(collection), collection.name
    reshape(collection, np.array([2.0, 1.0, 0, 0, 0, 0, 0, 0, 0, 0]))
    bpy.ops.ed.undo_push(message="reshaped")
    assert np.abs(drawn(bpy.data.collections[name]) - before).max() > 1e-3
    bpy.ops.ed.undo()
    np.testing.assert_allclose(drawn(bpy.data.collections[name]), before, atol=1e-6)


def test_an_appended_human_brings_splats_cells_and_nodes(person, tmp_path):
    collection, arrays = person
    name, path = collection.name, str(tmp_path / "source.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.wm.append(filename=name, directory=str(Path(path) / "Collection"))
    collection = bpy.data.collections[name]
    rotations, translation = strong_pose(5)
    pose_from_joint_rotations(armature_of(collection), rotations, translation)
    np.testing.assert_allclose(drawn(collection), expected(collection, arrays, rotations, translation), atol=2e-5)


def test_a_removed_human_leaves_no_splats(person):
    collection, _ = person
    assert splats_in(collection).parent == cells_in(collection).parent == armature_of(collection)
    remove_human(collection)
    assert not bpy.data.pointclouds
    assert not [obj for obj in bpy.data.objects if obj.type in ("POINTCLOUD", "MESH")]


def test_a_human_of_an_earlier_blender_refuses_splats(person):
    collection, _ = person
    bpy.data.objects.remove(splats_in(collection))
    with pytest.raises(ValueError, match=r"has no splats"):
        set_attachment(collection, "SPLATS")


def test_detail_and_size_are_inputs_of_the_group(person):
    collection, _ = person
    before = drawn(collection, "scale")
    items = bpy.data.node_groups[GROUP_NAME].interface.items_tree
    names = {item.name: item.identifier for item in items if item.in_out == "INPUT"}
    modifier = splats_in(collection).modifiers[0]
    set_node_input(modifier, names["Size"], 1.5)
    set_node_input(modifier, names["Detail"], 0.125)
    splats_in(collection).update_tag()
    after = drawn(collection, "scale")
    assert len(after) == math.ceil(len(before) / 8)
    np.testing.assert_allclose(after, 1.5 * 2 * before[: len(after)], rtol=1e-5)
