"""Files of people as others make them: the default body with other rigs' bones, rests, units and axes."""

from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.rotation import about_axis
from mathutils import Matrix

from blender_primdiffusion.capture.body import Body, skin, skinning_transforms
from blender_primdiffusion.scene.armature import build_armature
from blender_primdiffusion.scene.convention import points_to_blender

MIXAMO = {
    "pelvis": "mixamorig:Hips", "spine1": "mixamorig:Spine", "spine2": "mixamorig:Spine1", "spine3": "mixamorig:Spine2",
    "neck": "mixamorig:Neck", "head": "mixamorig:Head",
    **{f"{side}_{part}": f"mixamorig:{side.title()}{bone}" for side in ("left", "right") for part, bone in {
        "hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase", "collar": "Shoulder", "shoulder": "Arm",
        "elbow": "ForeArm", "wrist": "Hand", "hand": "HandMiddle1"}.items()},
}  # fmt: skip
UNREAL = {
    "pelvis": "pelvis", "spine1": "spine_01", "spine2": "spine_02", "spine3": "spine_03", "neck": "neck_01",
    "head": "head",
    **{f"{side}_{part}": f"{bone}_{side[0]}" for side in ("left", "right") for part, bone in {
        "hip": "thigh", "knee": "calf", "ankle": "foot", "foot": "ball", "collar": "clavicle", "shoulder": "upperarm",
        "elbow": "lowerarm", "wrist": "hand", "hand": "middle_01"}.items()},
}  # fmt: skip
RENDERPEOPLE = {
    "pelvis": "hip", "spine1": "spine_01", "spine2": "spine_02", "spine3": "spine_03", "neck": "neck", "head": "head",
    **{f"{side}_{part}": f"{bone}_{side[0]}" for side in ("left", "right") for part, bone in {
        "hip": "upperleg", "knee": "lowerleg", "ankle": "foot", "foot": "ball", "collar": "shoulder",
        "shoulder": "upperarm", "elbow": "lowerarm", "wrist": "hand", "hand": "middle_01"}.items()},
}  # fmt: skip
RENDERPEOPLE = {joint: f"rp_anna_rigged_001_{bone}" for joint, bone in RENDERPEOPLE.items()}
RIGIFY = {
    "pelvis": "spine", "spine1": "spine.001", "spine2": "spine.002", "spine3": "spine.003", "neck": "spine.004",
    "head": "spine.006",
    **{f"{side}_{part}": f"{bone}.{side[0].upper()}" for side in ("left", "right") for part, bone in {
        "hip": "thigh", "knee": "shin", "ankle": "foot", "foot": "toe", "collar": "shoulder", "shoulder": "upper_arm",
        "elbow": "forearm", "wrist": "hand", "hand": "f_middle.01"}.items()},
}  # fmt: skip
SOMA = {
    "pelvis": "Hips", "spine1": "Spine1", "spine2": "Spine2", "spine3": "Chest", "neck": "Neck1", "head": "Head",
    **{f"{side}_{part}": f"{side.title()}{bone}" for side in ("left", "right") for part, bone in {
        "hip": "Leg", "knee": "Shin", "ankle": "Foot", "foot": "ToeBase", "collar": "Shoulder", "shoulder": "Arm",
        "elbow": "ForeArm", "wrist": "Hand", "hand": "HandMiddleEnd"}.items()},
}  # fmt: skip
VROID = {
    "pelvis": "J_Bip_C_Hips", "spine1": "J_Bip_C_Spine", "spine2": "J_Bip_C_Chest", "spine3": "J_Bip_C_UpperChest",
    "neck": "J_Bip_C_Neck", "head": "J_Bip_C_Head",
    **{f"{side}_{part}": f"J_Bip_{side[0].upper()}_{bone}" for side in ("left", "right") for part, bone in {
        "hip": "UpperLeg", "knee": "LowerLeg", "ankle": "Foot", "foot": "ToeBase", "collar": "Shoulder",
        "shoulder": "UpperArm", "elbow": "LowerArm", "wrist": "Hand", "hand": "Middle1"}.items()},
}  # fmt: skip
MOCAPNET = {
    "pelvis": "hip", "spine1": "abdomen", "spine2": "waist", "spine3": "chest", "neck": "neck", "head": "head",
    **{f"{side}_{part}": f"{side[0]}{bone}" for side in ("left", "right") for part, bone in {
        "hip": "hip", "knee": "knee", "ankle": "foot", "foot": "bigtoe", "collar": "Collar", "shoulder": "shoulder",
        "elbow": "elbow", "wrist": "hand", "hand": "Mid1"}.items()},
}  # fmt: skip
ROKOKO = {
    "pelvis": "Hips", "spine1": "Spine1", "spine2": "Spine2", "spine3": "Spine4", "neck": "Neck", "head": "Head",
    **{f"{side}_{part}": f"{side.title()}{bone}" for side in ("left", "right") for part, bone in {
        "hip": "Thigh", "knee": "Shin", "ankle": "Foot", "foot": "Toe", "collar": "Shoulder", "shoulder": "Arm",
        "elbow": "ForeArm", "wrist": "Hand", "hand": "Finger3Proximal"}.items()},
}  # fmt: skip
RPM = {joint: bone.removeprefix("mixamorig:") for joint, bone in MIXAMO.items()}
"""Ready Player Me."""
OWN = {name: name for name in JOINT_NAMES}


def a_pose() -> np.ndarray:
    """Arms 45 degrees down, elbows bent, legs apart, feet flat and turned out: rotations [24, 3, 3] from the T rest."""
    rotations = np.tile(np.eye(3), (24, 1, 1))
    for side, sign in (("left", 1), ("right", -1)):
        apart = about_axis(2, sign * np.radians(6))
        rotations[JOINT_NAMES.index(f"{side}_shoulder")] = about_axis(2, -sign * np.radians(45))
        rotations[JOINT_NAMES.index(f"{side}_elbow")] = about_axis(1, -sign * np.radians(15))
        rotations[JOINT_NAMES.index(f"{side}_hip")] = apart
        rotations[JOINT_NAMES.index(f"{side}_ankle")] = apart.T @ about_axis(1, sign * np.radians(12))
    return rotations


def person(
    body: Body,
    betas: np.ndarray,
    rest: np.ndarray | None = None,
    names: dict[str, str] = OWN,
    picture: bpy.types.Image | None = None,
) -> tuple[bpy.types.Object, bpy.types.Object]:
    """The body as a skinned mesh and its armature in the scene, standing in the pose `rest` as its rest."""
    rotations = np.tile(np.eye(3), (24, 1, 1)) if rest is None else rest
    vertices, joints = body.rest(betas)
    joints, skinning = skinning_transforms(rotations, np.zeros(3), joints)
    vertices = skin(vertices, body.skin_weights, skinning)
    armature = build_armature("rig", points_to_blender(joints))
    bpy.context.scene.collection.objects.link(armature)
    for name in JOINT_NAMES:
        armature.data.bones[name].name = names[name]
    mesh = static(body, vertices, picture)
    for joint, name in enumerate(JOINT_NAMES):
        group = mesh.vertex_groups.new(name=names[name])
        for vertex in np.flatnonzero(body.skin_weights[:, joint]):
            group.add([int(vertex)], float(body.skin_weights[vertex, joint]), "REPLACE")
    mesh.parent = armature
    mesh.modifiers.new("Armature", "ARMATURE").object = armature
    return mesh, armature


def static(body: Body, vertices: np.ndarray, picture: bpy.types.Image | None = None) -> bpy.types.Object:
    """The body's faces over vertices [V, 3], y up, as a mesh in the scene."""
    mesh = bpy.data.meshes.new("person")
    mesh.from_pydata(points_to_blender(vertices).tolist(), [], body.faces.tolist())
    layer = mesh.uv_layers.new(name="UVMap")
    corners = np.asarray(body.faces).ravel()
    front = vertices[corners][:, :2] * 0.4 + 0.5
    layer.data.foreach_set("uv", front.astype(np.float32).ravel())
    obj = bpy.data.objects.new("person", mesh)
    bpy.context.scene.collection.objects.link(obj)
    material = bpy.data.materials.new("skin")
    if material.node_tree is None:
        material.use_nodes = True
    if picture is not None:
        shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
        node = material.node_tree.nodes.new("ShaderNodeTexImage")
        node.image = picture
        material.node_tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
    mesh.materials.append(material)
    return obj


def checker(path: Path) -> bpy.types.Image:
    """A colourful picture, saved."""
    rows, columns = np.mgrid[:64, :64]
    pixels = np.ones((64, 64, 4), np.float32)
    pixels[..., 0], pixels[..., 1] = columns / 64, rows / 64
    pixels[..., 2] = ((rows // 4 + columns // 4) % 2) * 0.8
    image = bpy.data.images.new(path.stem, 64, 64)
    image.pixels.foreach_set(pixels.ravel())
    path.parent.mkdir(parents=True, exist_ok=True)
    image.filepath_raw, image.file_format = str(path), "PNG" if path.suffix == ".png" else "JPEG"
    image.save()
    return image


def move(things: list[bpy.types.Object], matrix: np.ndarray) -> None:
    """Move everything without a parent by `matrix` [4, 4]."""
    for obj in things:
        if obj.parent is None:
            obj.matrix_world = Matrix(matrix.tolist()) @ obj.matrix_world
    bpy.context.view_layer.update()


def save(path: Path, **options: object) -> Path:
    """Export the scene by the file's ending, then empty it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    exporters: dict[str, Callable[..., object]] = {
        ".glb": bpy.ops.export_scene.gltf,
        ".fbx": bpy.ops.export_scene.fbx,
        ".obj": bpy.ops.wm.obj_export,
    }
    exporters[path.suffix](filepath=str(path), **options)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return path


def evaluated(things: list[bpy.types.Object]) -> np.ndarray:
    """Deformed vertices [V, 3] in the world, y up, as Blender draws them."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    clouds = []
    for obj in things:
        seen = obj.evaluated_get(depsgraph)
        matrix = np.array(seen.matrix_world)
        local = np.array([vertex.co for vertex in seen.data.vertices])
        clouds.append(local @ matrix[:3, :3].T + matrix[:3, 3])
    return np.concatenate(clouds) @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
