"""Splats: where Blender's nodes put them on a posed body, by the oracles; edits, copies, undo, appending, removal."""

import math
from pathlib import Path

import bpy
import numpy as np
import pytest
import synthetic
import synthetic_shape
from human_files import press_x
from human_stage import strong_pose
from oracle import Z_UP, blended_vertices, evaluated_matrices, world_from_model
from support.errors import refused

from blender_primdiffusion.engine.boxes import boxes_of
from blender_primdiffusion.engine.picture import posed_humans
from blender_primdiffusion.jobs.parts import complete_humans
from blender_primdiffusion.scene import build
from blender_primdiffusion.scene.armature import pose_from_joint_rotations
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.cells import set_input
from blender_primdiffusion.scene.edit import reshape
from blender_primdiffusion.scene.human import body_of, humans
from blender_primdiffusion.scene.representation import representation_of, set_representation
from blender_primdiffusion.scene.splats import C0, GROUP_NAME, SPLATS_AVAILABLE, WIDTH, cells_of, cloud_of
from blender_primdiffusion.scene.volume_nodes import volumes_of

pytestmark = [
    pytest.mark.usefixtures("splats"),
    pytest.mark.skipif(not SPLATS_AVAILABLE, reason="Gaussian splats came with Blender 5.3"),
]
COUNT = 12
FIELDS = {"position": ("vector", 3), "scale": ("vector", 3), "rotation": ("value", 4), "cell": ("value", 1)}


@pytest.fixture
def person(saved_scene, tmp_path):
    """A synthetic person in shot.blend, as (human, arrays)."""
    return build_human(saved_scene, synthetic_shape.write(tmp_path / "human", COUNT)), synthetic_shape.arrays(COUNT)


def read(cloud, name) -> np.ndarray:
    field, width = FIELDS[name]
    values = np.empty((len(cloud.points), width), np.int32 if name == "cell" else np.float32)
    cloud.attributes[name].data.foreach_get(field, values.ravel())
    return values


def drawn(human, name="position") -> np.ndarray:
    """What Blender draws of a human's splats, in the space of its armature."""
    bpy.context.view_layer.update()
    evaluated = cloud_of(human).evaluated_get(bpy.context.evaluated_depsgraph_get())
    assert evaluated.data.type == "GAUSSIAN_SPLAT"
    return read(evaluated.data, name)


def expected(human, arrays, rotations, translation) -> np.ndarray:
    """Where the splats belong in the armature's space: on the frames of the posed surface, by definition."""
    vertices = blended_vertices(arrays, rotations, translation) @ Z_UP[:3, :3]
    position, rotation = synthetic.frames(vertices, arrays)
    frames = np.tile(np.eye(4), (len(position), 1, 1))
    frames[:, :3, :3], frames[:, :3, 3] = rotation, position
    armature = human
    frames = world_from_model(armature, arrays["vertices"]) @ Z_UP @ frames
    frames = np.linalg.inv(np.array(armature.matrix_world)) @ frames
    cloud = cloud_of(human).data
    frames, local = frames[read(cloud, "cell")[:, 0]], read(cloud, "position")
    growth = arrays.get("growth", np.ones((COUNT, 3)))[read(cloud, "cell")[:, 0]]
    return np.einsum("nij,nj->ni", frames[:, :3, :3], local * growth) + frames[:, :3, 3]


@pytest.mark.parametrize("seed", [None, 1, 2])
def test_splats_lie_in_the_frames_of_the_posed_surface(person, seed):
    human, arrays = person
    rotations, translation = (np.tile(np.eye(3), (24, 1, 1)), np.zeros(3)) if seed is None else strong_pose(seed)
    pose_from_joint_rotations(human, rotations, translation)
    np.testing.assert_allclose(drawn(human), expected(human, arrays, rotations, translation), atol=2e-5)


def test_splats_follow_a_new_shape_grow_with_it_go_back_with_undo_and_leave_with_x(person):
    human, arrays = person
    betas = np.array([2.0, -1.0, 0, 0, 0, 0, 0, 0, 0, 0])
    before, name = drawn(human, "scale"), human.name
    bpy.ops.ed.undo_push(message="before")
    reshape(human, betas)
    rotations, translation = strong_pose(3)
    pose_from_joint_rotations(human, rotations, translation)
    wanted = synthetic_shape.at(arrays, betas)
    np.testing.assert_allclose(drawn(human), expected(human, wanted, rotations, translation), atol=5e-5)
    bpy.ops.ed.undo_push(message="reshaped")
    human = bpy.data.objects[name]
    cell = read(cloud_of(human).data, "cell")[:, 0]
    np.testing.assert_allclose(drawn(human, "scale"), before * wanted["growth"][cell], rtol=1e-4)
    bpy.ops.ed.undo()
    np.testing.assert_allclose(drawn(bpy.data.objects[name], "scale"), before, atol=1e-6)
    press_x(bpy.data.objects[name])
    assert not bpy.data.pointclouds
    assert not [obj for obj in bpy.data.objects if obj.type in ("POINTCLOUD", "MESH")]


def test_splats_of_the_sample_stretch_with_the_skin_as_the_engines_boxes_do(saved_scene):
    human = build_human(saved_scene, Path(build.__file__).parents[1] / "gallery" / "Sample.human")
    armature = human
    for bone, turn in (("left_hip", -1.5), ("left_knee", 1.2), ("right_shoulder", 0.6)):
        armature.pose.bones[bone].rotation_mode = "XYZ"
        armature.pose.bones[bone].rotation_euler[0] = turn
    cloud = cloud_of(human).data
    scale, cell = drawn(human, "scale"), read(cloud, "cell")[:, 0]
    boxes = boxes_of(posed_humans(bpy.context.evaluated_depsgraph_get())[0])
    np.testing.assert_allclose(scale, boxes.half_extent[cell] * 2 / 7 * np.array(WIDTH), rtol=2e-3)
    assert (scale / read(cloud, "scale")).max() > 1.3
    stretch = scale / read(cloud, "scale")
    places = np.einsum("nij,nj->ni", boxes.rotation[cell], read(cloud, "position") * stretch) + boxes.position[cell]
    in_world = drawn(human) @ np.array(armature.matrix_world)[:3, :3].T + np.array(armature.matrix_world)[:3, 3]
    np.testing.assert_allclose(in_world, np.stack([places[:, 0], -places[:, 2], places[:, 1]], -1), atol=2e-4)


def test_volumes_are_made_only_when_splats_no_longer_show_the_human(person):
    human, _ = person
    assert representation_of(human) == "SPLATS"
    assert volumes_of(human) is None
    assert not cloud_of(human).hide_render
    set_representation(human, "VOLUMES")
    assert len(evaluated_matrices(human)) == COUNT
    assert cloud_of(human).hide_render
    set_representation(human, "SPLATS")
    assert volumes_of(human).hide_render
    assert not cloud_of(human).hide_viewport


def test_a_human_of_volumes_gets_splats_when_they_are_asked_for(person):
    human, arrays = person
    set_representation(human, "VOLUMES")
    bpy.data.batch_remove([cloud_of(human), cells_of(human)])
    set_representation(human, "SPLATS")
    pose = strong_pose(1)
    pose_from_joint_rotations(human, *pose)
    np.testing.assert_allclose(drawn(human), expected(human, arrays, *pose), atol=2e-5)
    bpy.data.batch_remove([cloud_of(human), body_of(human)])
    with refused(ValueError, "deleted"):
        set_representation(human, "SPLATS")


@pytest.mark.parametrize("linked", [False, True], ids=["Shift-D", "Alt-D"])
def test_copies_have_splats_of_their_own(person, linked):
    human, arrays = person
    bpy.ops.object.select_all(action="DESELECT")
    human.select_set(True)
    bpy.ops.object.duplicate(linked=linked)
    complete_humans()
    copy = next(one for one in humans(bpy.context.scene) if one != human)
    still = drawn(human)
    rotations, translation = strong_pose(4)
    pose_from_joint_rotations(copy, rotations, translation)
    np.testing.assert_allclose(drawn(copy), expected(copy, arrays, rotations, translation), atol=2e-5)
    np.testing.assert_array_equal(drawn(human), still)
    assert len([group for group in bpy.data.node_groups if group.name.startswith(GROUP_NAME)]) == 1
    reshape(copy, np.array([3.0, 0, 0, 0, 0, 0, 0, 0, 0, 0]))
    np.testing.assert_array_equal(drawn(human), still)


@pytest.mark.parametrize("what", ["Collection", "Object"])
def test_an_appended_human_has_splats_cells_and_nodes(person, tmp_path, what):
    human, arrays = person
    name, path = human.name, str(tmp_path / "source.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.wm.append(filename=name, directory=str(Path(path) / what))
    complete_humans()
    human = bpy.data.objects[name]
    rotations, translation = strong_pose(5)
    pose_from_joint_rotations(human, rotations, translation)
    np.testing.assert_allclose(drawn(human), expected(human, arrays, rotations, translation), atol=2e-5)


def test_detail_and_size_are_inputs_of_the_group(person):
    human, _ = person
    before = drawn(human, "scale")
    modifier = cloud_of(human).modifiers[0]
    set_input(modifier, "Size", 1.5)
    set_input(modifier, "Detail", 0.125)
    cloud_of(human).update_tag()
    after = drawn(human, "scale")
    assert len(after) == math.ceil(len(before) / 8)
    np.testing.assert_allclose(after, 1.5 * 2 * before[: len(after)], rtol=1e-5)


def colours(human) -> np.ndarray:
    """Encoded colours and opacity [n, 4] as Blender draws them."""
    bpy.context.view_layer.update()
    attribute = cloud_of(human).evaluated_get(bpy.context.evaluated_depsgraph_get()).data.attributes["radiance:base"]
    values = np.empty((len(attribute.data), 4), np.float32)
    attribute.data.foreach_get("color", values.ravel())
    return np.c_[0.5 + C0 * values[:, :3], values[:, 3]]


def test_shading_darkens_what_is_turned_away_from_the_sun_and_leaves_opacity(person):
    human, _ = person
    stored = np.empty((len(cloud_of(human).data.points), 4), np.float32)
    cloud_of(human).data.attributes["radiance:base"].data.foreach_get("vector", stored.ravel())
    as_made = colours(human)
    np.testing.assert_allclose(as_made, np.c_[0.5 + C0 * stored[:, :3], stored[:, 3]], atol=1e-6)
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    bpy.context.scene.collection.objects.link(sun)
    sun.rotation_euler = (math.pi / 2, 0, 0)  # shines along +y, upon the face
    modifier = cloud_of(human).modifiers[0]
    set_input(modifier, "Sun", sun)
    set_input(modifier, "Shading", 1.0)
    cloud_of(human).update_tag()
    shaded, turn = colours(human), drawn(human, "rotation")
    w, x, y, z = turn.T
    facing = -2 * (y * z - w * x)  # the normals' part along -y
    wanted = (0.3 + 0.7 * facing.clip(0, None)) ** (1 / 2.2)
    np.testing.assert_allclose(shaded[:, :3], as_made[:, :3] * wanted[:, None], atol=1e-5)
    np.testing.assert_array_equal(shaded[:, 3], as_made[:, 3])
