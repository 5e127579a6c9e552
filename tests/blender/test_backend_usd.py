"""The backend's .usdz in Blender: the same mesh, skin and material as its .glb."""

import math

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from scipy import spatial

pytest.importorskip("torch")  # Blender 5.2's Python has none
pytestmark = pytest.mark.any_blender

from export_people import person  # noqa: E402
from primdiffusion.export.proxy import mesh_proxy, write_proxy_glb  # noqa: E402
from primdiffusion.export.usd import write_proxy_usdz  # noqa: E402
from primdiffusion.formats.requests import ProxySettings  # noqa: E402

LIFTED = "left_shoulder"
EXACT = 2e-4
"""Metres, and parts of the texture's side."""


def imported(path, operator):
    """Armature and skinned mesh of a file, in an empty scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    operator(filepath=str(path))
    armature = next(one for one in bpy.data.objects if one.type == "ARMATURE")
    return armature, next(one for one in bpy.data.objects if one.type == "MESH" and one.find_armature())


def corners(mesh):
    """Vertices of the faces' corners in the world [F, 3, 3], and their texture coordinates [F, 3, 2]."""
    evaluated = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get())
    made = evaluated.to_mesh()
    at = np.array([evaluated.matrix_world @ vertex.co for vertex in made.vertices])
    faces = np.array([tuple(polygon.vertices) for polygon in made.polygons])
    uv = np.array([tuple(corner.uv) for corner in made.uv_layers[0].data])
    return at[faces], uv.reshape(-1, 3, 2)


def lift(armature):
    """Turn an arm by 60 degrees about the world's y axis, whatever the axes of bone and armature."""
    bone = armature.pose.bones[LIFTED]
    now = armature.matrix_world @ bone.matrix
    about = Matrix.Translation(now.translation)
    turned = about @ Matrix.Rotation(math.radians(-60), 4, "Y") @ about.inverted() @ now
    bone.matrix = armature.matrix_world.inverted() @ turned
    bpy.context.view_layer.update()


def farthest(corners_of_one, corners_of_other):
    """Largest distance of a corner, with its texture coordinates, from the nearest one of the other mesh."""
    return spatial.KDTree(corners_of_other).query(corners_of_one)[0].max()


def test_blender_imports_the_same_skinned_and_textured_mesh_as_from_glb(tmp_path):
    proxy = mesh_proxy(person(), ProxySettings(spacing=0.012, triangles=2000, texture_px=128))
    write_proxy_glb(tmp_path / "person.glb", proxy, {})
    write_proxy_usdz(tmp_path / "person.usdz", proxy, {})
    found = {}
    for name, operator in (("glb", bpy.ops.import_scene.gltf), ("usdz", bpy.ops.wm.usd_import)):
        armature, mesh = imported(tmp_path / f"person.{name}", operator)
        rest, uv = corners(mesh)
        lift(armature)
        nodes = {node.type: node for node in mesh.data.materials[0].node_tree.nodes}
        image = nodes["TEX_IMAGE"].image
        found[name] = rest, corners(mesh)[0], uv, tuple(image.size), image.colorspace_settings.name
        assert [link.to_socket.name for link in nodes["TEX_IMAGE"].outputs["Color"].links] == ["Base Color"]
    glb, usd = found["glb"], found["usdz"]
    assert usd[3:] == glb[3:] == ((128, 128), "sRGB")
    assert len(usd[0]) == len(glb[0]) == len(proxy.faces)
    for rest_or_lifted in (0, 1):
        theirs, ours = (np.concatenate([each[rest_or_lifted], each[2]], axis=2).reshape(-1, 5) for each in (glb, usd))
        assert farthest(theirs, ours) < EXACT
        assert farthest(ours, theirs) < EXACT
    assert np.abs(usd[1] - usd[0]).max() > 0.2
