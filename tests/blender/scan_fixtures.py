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

_TRUNK = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
_LIMBS = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist", "hand")


def rig(trunk: str, limbs: str, sided: str) -> dict[str, str]:
    """A rig's bones by SMPL's joints, from the names of its trunk, of its limbs, and how a limb's side is written."""
    bones = dict(zip(_TRUNK, trunk.split(), strict=True))
    for side in ("left", "right"):
        forms = {"side": side.title(), "s": side[0], "S": side[0].upper()}
        bones |= {
            f"{side}_{part}": sided.format(bone, **forms) for part, bone in zip(_LIMBS, limbs.split(), strict=True)
        }
    return bones


RPM = rig(
    "Hips Spine Spine1 Spine2 Neck Head",
    "UpLeg Leg Foot ToeBase Shoulder Arm ForeArm Hand HandMiddle1", "{side}{}",
)  # fmt: skip
"""Ready Player Me."""
MIXAMO = {joint: f"mixamorig:{bone}" for joint, bone in RPM.items()}
UNREAL = rig(
    "pelvis spine_01 spine_02 spine_03 neck_01 head",
    "thigh calf foot ball clavicle upperarm lowerarm hand middle_01", "{}_{s}",
)  # fmt: skip
RENDERPEOPLE = rig(
    "hip spine_01 spine_02 spine_03 neck head",
    "upperleg lowerleg foot ball shoulder upperarm lowerarm hand middle_01", "{}_{s}",
)  # fmt: skip
RENDERPEOPLE = {joint: f"rp_anna_rigged_001_{bone}" for joint, bone in RENDERPEOPLE.items()}
RIGIFY = rig(
    "spine spine.001 spine.002 spine.003 spine.004 spine.006",
    "thigh shin foot toe shoulder upper_arm forearm hand f_middle.01", "{}.{S}",
)  # fmt: skip
SOMA = rig(
    "Hips Spine1 Spine2 Chest Neck1 Head",
    "Leg Shin Foot ToeBase Shoulder Arm ForeArm Hand HandMiddleEnd", "{side}{}",
)  # fmt: skip
VROID = rig(
    "J_Bip_C_Hips J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest J_Bip_C_Neck J_Bip_C_Head",
    "UpperLeg LowerLeg Foot ToeBase Shoulder UpperArm LowerArm Hand Middle1", "J_Bip_{S}_{}",
)  # fmt: skip
MOCAPNET = rig("hip abdomen waist chest neck head", "hip knee foot bigtoe Collar shoulder elbow hand Mid1", "{s}{}")
ROKOKO = rig(
    "Hips Spine1 Spine2 Spine4 Neck Head",
    "Thigh Shin Foot Toe Shoulder Arm ForeArm Hand Finger3Proximal", "{side}{}",
)  # fmt: skip
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
