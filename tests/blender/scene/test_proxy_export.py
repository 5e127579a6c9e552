"""Armature and mesh proxy as glTF and FBX: what was written is read back and compared."""

import bpy
import exporting
import numpy as np
import pytest
import synthetic
from support.errors import refused

from blender_primdiffusion.scene.armature import keyframe_poses
from blender_primdiffusion.scene.handles import add_handles
from blender_primdiffusion.scene.proxy import build_proxy, read_proxy, remove_proxy, write_model

EXACT = 1e-4
"""Metres."""


@pytest.fixture
def store(saved_scene, tmp_path):
    folder = tmp_path / "store"
    folder.mkdir()
    exporting.write_store(folder)
    return folder


@pytest.fixture
def moving(store):
    """Somebody who moves on frames 1 to 4, away from the origin and turned."""
    person = exporting.add_person(store)
    armature = person
    rng = np.random.default_rng(0)
    turns, places = synthetic.axis_angle(rng.normal(0, 0.3, (4, 24, 3))), rng.normal(0, 0.1, (4, 3))
    keyframe_poses(armature, np.arange(1, 5), turns, places)
    armature.location.x, armature.rotation_euler.z = 1.5, 0.7
    return person


def joints_and_vertices(armature, mesh):
    heads = [np.array(armature.matrix_world @ armature.pose.bones[name].head) for name in synthetic.NAMES]
    evaluated = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get())
    corners = [evaluated.matrix_world @ vertex.co for vertex in evaluated.data.vertices]
    return np.array(heads), np.array(corners)


def at_frames(armature, mesh, frames):
    found = []
    for frame in range(frames[0], frames[-1] + 1):
        bpy.context.scene.frame_set(frame)
        found.append(joints_and_vertices(armature, mesh))
    return found


def imported(path, kind):
    before = set(bpy.data.objects)
    if kind == "GLB":
        bpy.ops.import_scene.gltf(filepath=str(path))
    else:
        bpy.ops.import_scene.fbx(filepath=str(path), anim_offset=0.0)
    new = [obj for obj in bpy.data.objects if obj not in before]
    armature = next(obj for obj in new if obj.type == "ARMATURE")
    mesh = next(obj for obj in new if obj.type == "MESH" and obj.vertex_groups)
    return armature, mesh


def textures(mesh):
    nodes = [node for material in mesh.data.materials for node in material.node_tree.nodes]
    return [node.image for node in nodes if node.type == "TEX_IMAGE" and node.image]


@pytest.mark.parametrize(
    "frames", [range(1, 5), pytest.param(range(3, 4), marks=pytest.mark.any_blender)], ids=["animation", "pose"]
)
@pytest.mark.parametrize(("kind", "ending"), [("GLB", ".glb"), ("FBX", ".fbx")])
def test_joints_and_surface_are_where_they_were(moving, store, tmp_path, kind, ending, frames):
    armature = moving
    proxy = build_proxy(moving, read_proxy(store / "proxy.npz"), store / "proxy.png")
    bpy.context.scene.collection.objects.link(proxy)
    bpy.context.scene.frame_set(3)
    out = tmp_path / f"eine Frau ä{ending}"
    write_model(bpy.context, armature, proxy, out, kind, frames)
    wanted = at_frames(armature, proxy, frames)
    remove_proxy(proxy)
    armature, mesh = imported(out, kind)
    found = at_frames(armature, mesh, frames)
    for (joints, corners), (joints_back, corners_back) in zip(wanted, found, strict=True):
        assert np.abs(joints - joints_back).max() < EXACT
        near = np.linalg.norm(corners[:, None] - corners_back[None], axis=-1)
        assert near.min(1).max() < EXACT  # vertices may be split and reordered
    picture = textures(mesh)[0]
    assert tuple(picture.size) == (16, 16)
    assert picture.pixels[0] == pytest.approx(1.0)


@pytest.mark.parametrize(("kind", "ending"), [("GLB", ".glb"), ("FBX", ".fbx")])
def test_ik_handles_are_not_exported_and_their_effect_is(store, tmp_path, kind, ending):
    person = exporting.add_person(store)
    armature = person
    add_handles(bpy.context, armature)
    armature.pose.bones["pelvis"].location.y = -0.1
    for frame, height in ((1, 0.0), (4, 0.3)):
        armature.pose.bones["left_foot_ik"].location.z = height
        armature.pose.bones["left_foot_ik"].keyframe_insert("location", frame=frame)
    proxy = build_proxy(person, read_proxy(store / "proxy.npz"), store / "proxy.png")
    bpy.context.scene.collection.objects.link(proxy)
    frames = range(1, 5)
    write_model(bpy.context, armature, proxy, tmp_path / f"a{ending}", kind, frames)
    wanted = at_frames(armature, proxy, frames)
    assert np.abs(wanted[0][0] - wanted[3][0]).max() > 0.1
    back, mesh = imported(tmp_path / f"a{ending}", kind)
    assert sorted(bone.name for bone in back.data.bones) == sorted(synthetic.NAMES)
    for (joints, _), (joints_back, _) in zip(wanted, at_frames(back, mesh, frames), strict=True):
        assert np.abs(joints - joints_back).max() < EXACT


def test_exporting_leaves_the_scene_as_it_was(moving, store, tmp_path):
    proxy = build_proxy(moving, read_proxy(store / "proxy.npz"), store / "proxy.png")
    armature = moving
    armature.hide_viewport, armature.data.pose_position = True, "REST"
    bpy.context.scene.frame_set(2)
    kinds = ("scenes", "objects", "meshes", "armatures", "actions", "materials", "images", "collections")
    before = {kind: {obj.name for obj in getattr(bpy.data, kind)} for kind in kinds}
    write_model(bpy.context, armature, proxy, tmp_path / "a.glb", "GLB", range(1, 5))
    assert {kind: {obj.name for obj in getattr(bpy.data, kind)} for kind in kinds} == before
    assert bpy.context.scene.frame_current == 2
    assert armature.hide_viewport
    assert armature.data.pose_position == "REST"


def test_an_exporter_that_is_disabled_is_enabled_for_the_moment(moving, store, tmp_path):
    import addon_utils

    proxy = build_proxy(moving, read_proxy(store / "proxy.npz"), store / "proxy.png")
    addon_utils.disable("io_scene_fbx")
    try:
        write_model(bpy.context, moving, proxy, tmp_path / "a.fbx", "FBX", range(1, 3))
        assert (tmp_path / "a.fbx").is_file()
        assert not addon_utils.check("io_scene_fbx")[1]
    finally:
        addon_utils.enable("io_scene_fbx")


@pytest.mark.any_blender
def test_an_armature_in_edit_mode_or_without_a_bone_is_rejected(moving, store, tmp_path):
    proxy = build_proxy(moving, read_proxy(store / "proxy.npz"), store / "proxy.png")
    armature = moving
    armature.data.bones["head"].name = "skull"
    with refused(ValueError, "'head'"):
        write_model(bpy.context, armature, proxy, tmp_path / "a.glb", "GLB", range(1, 2))
    armature.data.bones["skull"].name = "head"
    bpy.ops.object.mode_set(mode="EDIT")
    with refused(ValueError, "Edit Mode"):
        write_model(bpy.context, armature, proxy, tmp_path / "a.glb", "GLB", range(1, 2))
    assert not (tmp_path / "a.glb").exists()


@pytest.mark.any_blender
@pytest.mark.parametrize("field", ["faces", "skin_weights", "joint_names"])
def test_a_damaged_proxy_is_rejected(store, tmp_path, field):
    with np.load(store / "proxy.npz") as archive:
        arrays = dict(archive)
    arrays[field] = arrays[field][:-1] if field != "faces" else arrays[field] + 10**6
    np.savez(tmp_path / "damaged.npz", **arrays)
    with pytest.raises(ValueError, match=r"again|release"):
        read_proxy(tmp_path / "damaged.npz")
