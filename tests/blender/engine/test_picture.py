"""The engine's pictures are the backend's, pixel for pixel, however the camera is set and the armature is moved."""

import math
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import synthetic
from engine_stage import (
    STEP,
    Z_UP,
    add_human,
    camera_by_hand,
    eight_bit,
    pixels,
    read_layers,
    render_exr,
    render_png,
    set_up_render,
)
from human_files import lose_data, remove_human
from mathutils import Euler, Matrix
from oracle import raised, world_from_model
from support.errors import refused

from blender_primdiffusion.scene.armature import keyframe_poses, pose_from_joint_rotations
from blender_primdiffusion.scene.human_file import read_human, shape_model_of
from blender_primdiffusion.scene.shape import betas_of

SIZE = (120, 90)
REST = np.tile(np.eye(3), (24, 1, 1))


@pytest.fixture(scope="module")
def backend(oracle, folder, tmp_path_factory):
    """The oracle, and the folders of two people it has made."""
    second = oracle.make(tmp_path_factory.mktemp("second"), 2, [1.5, -1.0, 0.5] + [0.0] * 7)
    return SimpleNamespace(oracle=oracle, folders=[folder, second])


@pytest.fixture
def stage(extension, saved_scene, backend, tmp_path):
    """One person before a camera, transparent film, colours as they are."""
    scene = saved_scene.scene
    camera = set_up_render(scene, SIZE, (0.5, -3.0, 1.2), (math.radians(84), 0, math.radians(9)))
    scene.primdiffusion_render.step = STEP
    person = add_human(backend.folders[0])
    return SimpleNamespace(scene=scene, camera=camera, person=person, armature=person, out=tmp_path / "picture.png")


def placed(matrix, folder) -> np.ndarray:
    """The world from the body model's space [4, 4], for an armature at `matrix` with the rest body of a folder."""
    return np.array(matrix) @ raised(read_human(folder / "person.human.safetensors").rest.vertices)


def as_asked(folder, armature, rotations=REST, translation=(0, 0, 0)) -> dict:
    """A person for the oracle: pose, and the place of the body model's space turned into the backend's axes."""
    world = Z_UP.T @ placed(armature.matrix_world, folder) @ Z_UP
    return {
        "folder": str(folder),
        "rotations": np.asarray(rotations).tolist(),
        "translation": list(translation),
        "world": world.tolist(),
    }


def expected(stage, backend, people=None, size=SIZE, step=STEP) -> tuple[np.ndarray, np.ndarray]:
    bpy.context.view_layer.update()
    render = stage.scene.render
    camera = camera_by_hand(stage.camera, size, (render.pixel_aspect_x, render.pixel_aspect_y))
    people = people or [as_asked(backend.folders[0], stage.armature)]
    return backend.oracle.picture(people, camera, size, step)


def assert_same(given: np.ndarray, wanted: np.ndarray) -> None:
    assert given.shape == wanted.shape
    assert 0.02 < (wanted[..., 3] > 0).mean() < 0.98  # the person is in the picture, and so is something else
    assert np.abs(given - wanted).max() <= 1


def strong_pose(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return synthetic.axis_angle(rng.normal(0, 0.4, (24, 3))), rng.normal(0, 0.2, 3)


@pytest.mark.parametrize(
    ("full", "percent", "size"),
    [
        ((120, 90), 100, (120, 90)),
        pytest.param((64, 128), 100, (64, 128), marks=pytest.mark.any_blender),
        pytest.param((203, 151), 60, (121, 90), marks=pytest.mark.any_blender),
    ],
)
def test_a_picture_is_the_backends_to_a_255th(stage, backend, full, percent, size):
    stage.scene.render.resolution_x, stage.scene.render.resolution_y = full
    stage.scene.render.resolution_percentage = percent
    combined, _ = expected(stage, backend, size=size)
    assert_same(render_png(stage.out), eight_bit(combined))


@pytest.mark.parametrize("size", [(120, 80), pytest.param((80, 120), marks=pytest.mark.any_blender)])
@pytest.mark.parametrize("fit", ["AUTO", "VERTICAL", pytest.param("HORIZONTAL", marks=pytest.mark.any_blender)])
def test_lens_shift_sensor_fit_and_pixel_aspect_are_blenders(stage, backend, fit, size):
    data = stage.camera.data
    data.lens, data.shift_x, data.shift_y, data.sensor_fit = 42.0, 0.11, -0.07, fit
    data.sensor_width, data.sensor_height = 31.0, 22.0
    render = stage.scene.render
    render.resolution_x, render.resolution_y = size
    render.pixel_aspect_x, render.pixel_aspect_y = 1.0, 1.4
    combined, _ = expected(stage, backend, size=size)
    assert_same(render_png(stage.out), eight_bit(combined))


def test_the_cameras_scale_and_parents_do_not_change_the_lens(stage, backend):
    parent = bpy.data.objects.new("crane", None)
    stage.scene.collection.objects.link(parent)
    parent.scale, parent.rotation_euler = (2.0, 2.0, 2.0), (0.1, -0.1, 0.2)
    stage.camera.parent = parent
    stage.camera.scale, stage.camera.location = (1.0, 3.0, 0.5), (0.1, -1.5, 0.6)
    combined, _ = expected(stage, backend)
    assert_same(render_png(stage.out), eight_bit(combined))


def test_a_border_is_the_same_pixels_of_the_whole_picture(stage, backend):
    render = stage.scene.render
    render.use_border = True
    render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.27, 0.71, 0.33, 0.93
    wanted = eight_bit(expected(stage, backend)[0])
    left, right, bottom, top = int(0.27 * 120), int(0.71 * 120), int(0.33 * 90), int(0.93 * 90)
    part = wanted[90 - top : 90 - bottom, left:right]
    render.use_crop_to_border = True
    assert_same(render_png(stage.out), part)
    render.use_crop_to_border = False
    whole = render_png(stage.out)
    assert whole.shape == wanted.shape
    assert np.abs(whole[90 - top : 90 - bottom, left:right] - part).max() <= 1
    assert not whole[: 90 - top].any()
    assert not whole[:, :left].any()


def test_depth_is_the_backends_first_hit_along_the_optical_axis(stage, backend):
    combined, depth = expected(stage, backend)
    given, given_depth = render_exr(stage.out.with_suffix(".exr"))
    np.testing.assert_allclose(given, combined, atol=2e-3)
    there = depth < 1e9
    assert (there == (given_depth < 1e9)).mean() > 0.999
    both = there & (given_depth < 1e9)
    assert np.abs(depth - given_depth)[both].max() < STEP
    assert (given_depth[~both] == np.float32(1e10)).any()


@pytest.mark.parametrize(
    ("seed", "scale", "step"), [(0, 0.8, STEP), pytest.param(1, 0.6, STEP / 2, marks=pytest.mark.any_blender)]
)
def test_a_posed_scaled_and_rotated_armature_renders_as_posed(stage, backend, seed, scale, step):
    rotations, translation = strong_pose(seed)
    pose_from_joint_rotations(stage.armature, rotations, translation)
    turn = Euler((0.3, -0.2, 0.8)).to_matrix().to_4x4()
    stage.armature.matrix_world = Matrix.Translation((0.2, -0.3, 1.1)) @ turn @ Matrix.Scale(scale, 4)
    bpy.context.view_layer.update()
    people = [as_asked(backend.folders[0], stage.armature, rotations, translation)]
    assert_same(render_png(stage.out), eight_bit(expected(stage, backend, people, step=step)[0]))


def test_constraints_parents_and_drivers_reach_the_picture(stage, backend):
    target = bpy.data.objects.new("target", None)
    parent = bpy.data.objects.new("parent", None)
    for obj in (target, parent):
        stage.scene.collection.objects.link(obj)
    parent.location, parent.rotation_euler = (0.1, 0.4, 0.0), (0.0, 0.0, 0.5)
    stage.armature.parent = parent
    turn = synthetic.axis_angle(np.array([0.0, 0.0, 0.9]))
    bone = stage.armature.pose.bones["left_shoulder"]
    rest = np.array(stage.armature.data.bones["left_shoulder"].matrix_local.to_3x3())
    local = rest.T @ (Z_UP[:3, :3] @ turn @ Z_UP[:3, :3].T) @ rest
    target.rotation_mode = "QUATERNION"
    target.rotation_quaternion = Matrix(local.tolist()).to_quaternion()
    constraint = bone.constraints.new("COPY_ROTATION")
    constraint.target, constraint.owner_space = target, "LOCAL"
    driver = stage.armature.driver_add("location", 2).driver
    driver.expression = f"{stage.armature.location.z} + 0.25"
    rotations = REST.copy()
    rotations[16] = turn
    bpy.context.view_layer.update()
    people = [as_asked(backend.folders[0], stage.armature, rotations)]
    assert_same(render_png(stage.out), eight_bit(expected(stage, backend, people)[0]))


def test_every_frame_of_an_animation_has_its_own_pose(stage, backend, tmp_path):
    frames = np.arange(1, 4)
    swing = np.zeros((3, 24, 3))
    swing[:, 16, 2], swing[:, 1, 0] = [-1.0, 0.0, 1.0], [0.5, 0.0, -0.5]
    rotations, translations = synthetic.axis_angle(swing), np.outer([0.0, 0.1, 0.2], [1, 0, 0])
    keyframe_poses(stage.armature, frames, rotations, translations)
    stage.scene.frame_start, stage.scene.frame_end = 1, 3
    stage.scene.render.image_settings.file_format = "PNG"
    stage.scene.render.image_settings.color_mode = "RGBA"
    stage.scene.render.filepath = str(tmp_path / "frame_")
    bpy.ops.render.render(animation=True)
    for index, frame in enumerate(frames):
        people = [as_asked(backend.folders[0], stage.armature, rotations[index], translations[index])]
        given = np.round(255 * pixels(tmp_path / f"frame_{frame:04d}.png"))
        assert_same(given, eight_bit(expected(stage, backend, people)[0]))


def test_two_people_share_one_picture_and_the_hidden_are_left_out(stage, backend):
    second = add_human(backend.folders[1])
    second.location.x += 0.35
    second.location.y += 0.3
    bpy.context.view_layer.update()
    first = as_asked(backend.folders[0], stage.armature)
    other = as_asked(backend.folders[1], second)
    both = eight_bit(expected(stage, backend, [first, other])[0])
    assert_same(render_png(stage.out), both)
    layer = bpy.context.view_layer.layer_collection.children[second.name]
    layer.exclude = True
    alone = eight_bit(expected(stage, backend, [first])[0])
    assert_same(render_png(stage.out), alone)
    layer.exclude = False
    second.hide_render = True
    assert_same(render_png(stage.out), alone)


def test_an_instanced_human_renders_at_the_instance(stage, backend):
    instance = bpy.data.objects.new("again", None)
    stage.scene.collection.objects.link(instance)
    instance.instance_type, instance.instance_collection = "COLLECTION", bpy.data.collections[stage.person.name]
    instance.location = (0.6, 0.2, 0.0)
    bpy.context.view_layer.update()
    here = as_asked(backend.folders[0], stage.armature)
    world = placed(instance.matrix_world @ stage.armature.matrix_world, backend.folders[0])
    there = {**here, "world": (Z_UP.T @ world @ Z_UP).tolist()}
    assert_same(render_png(stage.out), eight_bit(expected(stage, backend, [here, there])[0]))


def test_a_linked_human_renders_from_the_library_file(stage, backend, tmp_path):
    wanted = eight_bit(expected(stage, backend)[0])
    bpy.ops.wm.save_mainfile()
    (tmp_path / "other").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other" / "linking.blend"))
    remove_human(stage.person)
    with bpy.data.libraries.load(str(tmp_path / "shot.blend"), link=True) as (_, wants):
        wants.collections = ["Human"]
    instance = bpy.data.objects.new("linked", None)
    instance.instance_type, instance.instance_collection = "COLLECTION", wants.collections[0]
    bpy.context.scene.collection.objects.link(instance)
    assert_same(render_png(stage.out), wanted)


def test_each_view_layer_has_its_own_people(stage, backend):
    nobody = stage.scene.view_layers.new("Nobody")
    nobody.layer_collection.children[stage.person.name].exclude = True
    render_exr(stage.out.with_suffix(".exr"))
    empty, _ = read_layers(stage.out.with_suffix(".exr"), "Nobody")
    full, _ = read_layers(stage.out.with_suffix(".exr"), "ViewLayer")
    assert not empty.any()
    np.testing.assert_allclose(full, expected(stage, backend)[0], atol=2e-3)


def test_an_opaque_film_shows_the_worlds_colour_behind_people_and_without_a_world_black(stage, backend):
    world = bpy.data.worlds.new("World")
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = (0.1, 0.2, 0.4, 1), 1.5
    stage.scene.world = world
    stage.scene.render.film_transparent = False
    combined, _ = expected(stage, backend)
    over = combined[..., :3] + (1 - combined[..., 3:]) * np.array([0.15, 0.3, 0.6])
    wanted = eight_bit(np.concatenate([over, np.ones_like(over[..., :1])], -1))
    for mode in ("RGB", "RGBA"):
        assert np.abs(render_png(stage.out, mode) - wanted).max() <= 1
    stage.scene.world = None
    combined[..., 3] = 1
    assert np.abs(render_png(stage.out, "RGB") - eight_bit(combined)).max() <= 1


@pytest.mark.any_blender
def test_the_far_clip_plane_cuts_people_off(stage):
    assert render_png(stage.out)[..., 3].any()
    stage.camera.data.clip_end = 2.0
    assert not render_png(stage.out).any()


def test_an_orthographic_camera_keeps_the_scale_of_the_person(stage, backend):
    data = stage.camera.data
    stage.camera.location, stage.camera.rotation_euler = (0.0, -3.0, 1.0), (math.pi / 2, 0, 0)
    data.type, data.ortho_scale, data.shift_x = "ORTHO", 2.4, 0.05
    given, depth = render_exr(stage.out.with_suffix(".exr"))
    metres = 2.4 / SIZE[0]
    # A pinhole of the oracle's own, far away and with a long lens.
    far = 3000.0
    axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ Z_UP[:3, :3]
    eye = np.array([0.0, -far, 1.0])
    camera = {
        "intrinsics": [[far / metres, 0, 60 - 0.05 * 120], [0, far / metres, 45], [0, 0, 1]],
        "world_to_camera": np.concatenate([axes, -(axes @ Z_UP[:3, :3].T @ eye)[:, None]], 1).tolist(),
    }
    people = [as_asked(backend.folders[0], stage.armature)]
    combined, far_depth = backend.oracle.picture(people, camera, SIZE)
    assert np.abs(given - combined)[..., 3].mean() < 0.002
    there = (depth < 1e9) & (far_depth < 1e9)
    assert there.mean() > 0.02
    assert np.abs(depth[there] - (far_depth[there] - far + 3.0)).mean() < STEP


@pytest.mark.any_blender
def test_a_person_scaled_to_nothing_is_not_there_and_nan_is_an_error(stage):
    for scale in ((0, 0, 0), (1, 1, 0)):
        stage.armature.scale = scale
        assert not render_png(stage.out).any()
    stage.armature.scale = (1, 1, 1)
    stage.armature.location.x = float("nan")
    with refused(RuntimeError, "Human", "NaN"):
        render_png(stage.out)


@pytest.mark.any_blender
def test_one_percent_and_the_smallest_picture_render(stage, backend):
    render = stage.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = 1200, 900, 1
    assert_same(render_png(stage.out), eight_bit(expected(stage, backend, size=(12, 9))[0]))
    render.resolution_x = render.resolution_y = 1  # Blender makes it 4
    render.resolution_percentage = 100
    wanted = eight_bit(expected(stage, backend, size=(4, 4))[0])
    assert np.abs(render_png(stage.out) - wanted).max() <= 1


@pytest.mark.any_blender
def test_a_human_without_data_is_one_error_that_names_it(stage):
    lose_data(stage.person)
    with refused(RuntimeError, "Human", "holds no data") as caught:
        render_png(stage.out)
    assert str(caught.value).count("Error:") == 1
    assert not stage.out.exists()


def test_undo_and_frame_changes_do_not_disturb_the_engine(stage, backend):
    wanted = eight_bit(expected(stage, backend)[0])
    bpy.ops.ed.undo_push(message="before")
    stage.armature.location.x += 1.0
    bpy.ops.ed.undo_push(message="moved")
    bpy.context.scene.frame_set(5)
    render_png(stage.out)
    bpy.ops.ed.undo()
    bpy.context.scene.frame_set(1)
    assert_same(render_png(stage.out), wanted)


def test_the_engine_draws_a_reshaped_posed_person_as_the_backend_does(stage, backend):
    armature = stage.person
    rng = np.random.default_rng(2)
    rotations, translation = synthetic.axis_angle(rng.normal(0, 0.3, (24, 3))), np.array([0.1, 0.05, 0.0])
    pose_from_joint_rotations(armature, rotations, translation)
    armature.primdiffusion_human.betas = [1.5, -2.0, 1.0, 0, 0, 1.0, 0, 0, 0, 0]
    armature.primdiffusion_human.height = 1.82
    bpy.context.view_layer.update()
    body = shape_model_of(stage.person).surface(betas_of(stage.person))
    asked = {
        "folder": str(backend.folders[0]),
        "rotations": rotations.tolist(),
        "translation": translation.tolist(),
        "world": (Z_UP.T @ world_from_model(armature, body) @ Z_UP).tolist(),
        "betas": betas_of(stage.person).tolist(),
    }
    combined, _ = backend.oracle.picture([asked], camera_by_hand(stage.camera, SIZE), SIZE)
    wanted = eight_bit(combined)
    assert 0.02 < (wanted[..., 3] > 0).mean() < 0.98
    assert np.abs(render_png(stage.out) - wanted).max() <= 1
    as_generated, _ = backend.oracle.picture([{**asked, "betas": [0.0] * 10}], camera_by_hand(stage.camera, SIZE), SIZE)
    assert np.abs(eight_bit(as_generated) - wanted).max() > 30
