"""A person for tests of captures: the default body with few faces, painted, and posed by numpy rather than by bones."""

import dataclasses
from functools import cache
from pathlib import Path

import bpy
import numpy as np
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.motion import Motion
from synthetic import axis_angle

from blender_primdiffusion.capture.body import Body, read_body
from blender_primdiffusion.scene.convention import points_to_blender

FACES = 1500


@dataclasses.dataclass(frozen=True)
class NamedPerson:
    """Stands for a scan's file."""

    name: str


class PaintedPerson:
    """What the capture needs of a scan. Its surface is known exactly: `vertices` in the backend's axes, as posed."""

    def __init__(self, context: bpy.types.Context, body: Body, paint: bpy.types.Material):
        kept, self.faces = _few_faces()
        self._body, self._kept = body, kept
        self.betas, self.body, self.notes = np.zeros(10), "default", ["it is painted"]
        mesh = bpy.data.meshes.new("painted")
        mesh.from_pydata(np.zeros((len(kept), 3)).tolist(), [], self.faces.tolist())
        mesh.materials.append(paint)
        uv = mesh.uv_layers.new(name="UVMap")
        rest = body.rest(self.betas)[0][kept]
        uv.data.foreach_set("uv", (rest[self.faces.ravel(), :2] / 2 + 0.5).astype(np.float32).ravel())
        obj = bpy.data.objects.new("painted", mesh)
        context.scene.collection.objects.link(obj)
        for joint, name in enumerate(JOINT_NAMES):
            group = obj.vertex_groups.new(name=name)
            for vertex in np.flatnonzero(body.skin_weights[kept, joint] > 0):
                group.add([int(vertex)], float(body.skin_weights[kept[vertex], joint]), "REPLACE")
        self.objects = [obj]
        self.vertices = rest

    @staticmethod
    def joint_of_group(name: str) -> int | None:
        return JOINT_NAMES.index(name) if name in JOINT_NAMES else None

    def pose(self, rotations, translation):
        vertices, joints, _ = self._body.pose(self.betas, rotations, translation)
        self.vertices = vertices[self._kept]
        mesh = self.objects[0].data
        mesh.vertices.foreach_set("co", points_to_blender(self.vertices).astype(np.float32).ravel())
        mesh.update()
        return joints

    def bounds(self, rotations, translations):
        poses = zip(rotations, translations, strict=True)
        return np.concatenate([self._body.pose(self.betas, *pose)[0][self._kept] for pose in poses])


def load_painted(context, scan_file, body) -> PaintedPerson:
    """A loader of scans: a person with a chequered texture of two colours."""
    return PaintedPerson(context, body, chequers())


def chequers(size: int = 64) -> bpy.types.Material:
    """A Principled material with a texture of bright and dark squares."""
    rows, columns = np.mgrid[:size, :size] // 4
    pixels = np.ones((size, size, 4), np.float32)
    pixels[..., :3] = np.where(((rows + columns) % 2)[..., None], (0.9, 0.3, 0.1), (0.1, 0.4, 0.8))
    image = bpy.data.images.new("chequers", size, size)
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    made = plain((1, 1, 1))
    texture = made.node_tree.nodes.new("ShaderNodeTexImage")
    texture.image = image
    made.node_tree.links.new(texture.outputs["Color"], shader_of(made).inputs["Base Color"])
    return made


def plain(colour) -> bpy.types.Material:
    """A Principled material of one linear colour."""
    made = bpy.data.materials.new("paint")
    if made.node_tree is None:
        made.use_nodes = True
    shader_of(made).inputs["Base Color"].default_value = (*colour, 1)
    return made


def shader_of(material: bpy.types.Material) -> bpy.types.Node:
    return next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")


def two_poses() -> Motion:
    """The rest pose and one with turned limbs."""
    turned = np.zeros((2, 24, 3))
    turned[1, 0], turned[1, 16], turned[1, 1], turned[1, 5] = (0, 0.7, 0), (0.2, 0, -0.9), (-0.6, 0, 0.2), (0.8, 0, 0)
    return Motion(axis_angle(turned), np.zeros((2, 3)), 1.0, "two poses")


def files_of(folder: Path) -> dict[str, bytes]:
    """Everything in a folder but hidden files, by relative path."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(".")
    }


@cache
def _few_faces() -> tuple[np.ndarray, np.ndarray]:
    """Numbers of vertices of the default body, and faces between them, closed as the body is nearly."""
    body = read_body()
    mesh = bpy.data.meshes.new("whole")
    mesh.from_pydata(body.template.tolist(), [], body.faces.tolist())
    obj = bpy.data.objects.new("whole", mesh)
    bpy.context.scene.collection.objects.link(obj)
    obj.modifiers.new("fewer", "DECIMATE").ratio = FACES / len(body.faces)
    fewer = obj.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    points = np.empty(3 * len(fewer.vertices), np.float32)
    fewer.vertices.foreach_get("co", points)
    faces = np.array([tuple(polygon.vertices) for polygon in fewer.polygons])
    nearest = np.array([((body.template - point) ** 2).sum(-1).argmin() for point in points.reshape(-1, 3)])
    bpy.data.objects.remove(obj)
    bpy.data.meshes.remove(mesh)
    return nearest, faces
