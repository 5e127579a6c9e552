"""The glTF files of people, read back by an independent reader of the format."""

import io
import json
import struct

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from primdiffusion.body.model import BodyPose, J, default_body
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.textured_mesh import TexturedMesh, TexturedPart
from primdiffusion.people.gltf import Skeleton, glb
from support.errors import refused

COMPONENTS = {5126: "<f4", 5121: "<u1", 5123: "<u2", 5125: "<u4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Reader:
    def __init__(self, data):
        length = struct.unpack_from("<4sII", data)[2]
        assert length == len(data)
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON"
        self.document = json.loads(data[20 : 20 + size])
        self.binary = data[28 + size :]

    def view(self, number):
        view = self.document["bufferViews"][number]
        return self.binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]

    def array(self, number):
        accessor = self.document["accessors"][number]
        flat = np.frombuffer(self.view(accessor["bufferView"]), COMPONENTS[accessor["componentType"]])
        return flat.reshape(accessor["count"], WIDTHS[accessor["type"]])

    def part(self, name):
        mesh = next(mesh for mesh in self.document["meshes"] if mesh["name"] == name)
        primitive = mesh["primitives"][0]
        arrays = {key: self.array(number) for key, number in primitive["attributes"].items()}
        return (
            arrays,
            self.array(primitive["indices"]).reshape(-1, 3),
            self.document["materials"][primitive["material"]],
        )

    def picture(self, name):
        image = next(image for image in self.document["images"] if image["name"] == name)
        return image["mimeType"], np.array(Image.open(io.BytesIO(self.view(image["bufferView"]))))

    def skinned(self, name, world_from_joint):
        """Vertices by the rule of glTF: sum of weights times joint matrix times inverse bind matrix."""
        arrays, _, _ = self.part(name)
        inverse = self.array(self.document["skins"][0]["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        matrix = np.einsum("vm,vmij->vij", arrays["WEIGHTS_0"], (world_from_joint @ inverse)[arrays["JOINTS_0"]])
        return np.einsum("vij,vj->vi", matrix[:, :3, :3], arrays["POSITION"]) + matrix[:, :3, 3]


def skeleton():
    body = default_body()
    return Skeleton(JOINT_NAMES, body.parents.tolist(), body.shape(torch.zeros(10)).joints.double().numpy())


def person():
    """A part of the body, and a card with a hole whose texture coordinates split its vertices."""
    body = default_body()
    vertices, faces = body.template.double().numpy(), body.faces.numpy().astype(np.int32)
    weight, index = body.skin_weights.double().topk(4, dim=1)
    picture = np.full((8, 8, 4), 255, np.uint8)
    picture[..., 0] = np.linspace(0, 255, 8)[:, None]
    uv = body.uv.double().numpy()[body.uv_faces.numpy()]
    skin = TexturedPart("body", vertices, faces, uv, picture, index.numpy(), (weight / weight.sum(1, True)).numpy())
    holes = picture.copy()
    holes[4:, :, 3] = 0
    corners = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0]])
    coordinates = np.array([[[0, 0], [1, 0], [0, 1]], [[1, 0], [0.5, 0.5], [0, 1]], [[0, 0], [0, 1], [1, 1]]], float)
    triangles = np.array([[0, 1, 2], [1, 3, 2], [0, 2, 3]], np.int32)
    one, all_of_it = np.full((4, 1), 15), np.ones((4, 1))
    return TexturedMesh((skin, TexturedPart("hair", corners, triangles, coordinates, holes, one, all_of_it)))


def translation(offset):
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return matrix


@pytest.fixture(scope="module")
def written():
    return Reader(glb(person(), skeleton(), {"primdiffusion": {"betas": [0.0] * 10}}))


def test_joints_are_named_parented_and_placed_as_the_body_s(written):
    nodes, skin = written.document["nodes"], written.document["skins"][0]
    assert [nodes[joint]["name"] for joint in skin["joints"]] == list(JOINT_NAMES)
    place = np.zeros((J, 3))
    for joint, parent in enumerate(default_body().parents.tolist()):
        if parent >= 0:
            assert joint in nodes[parent]["children"]
        place[joint] = np.array(nodes[joint]["translation"]) + (place[parent] if parent >= 0 else 0)
    assert np.abs(place - skeleton().positions).max() < 1e-6


def test_skinning_by_the_rule_of_gltf_is_that_of_the_mesh(written):
    theta = torch.randn(72, generator=torch.Generator().manual_seed(0)) * 0.5
    shaped = default_body().shape(torch.zeros(10))
    posed = shaped.pose(BodyPose.from_axis_angle(theta))
    skinning = posed.skinning.double().numpy()
    world_from_joint = skinning @ np.array([translation(joint) for joint in skeleton().positions])
    for part in person().posed(skinning).parts:
        arrays, faces, _ = written.part(part.name)
        moved = written.skinned(part.name, world_from_joint)
        assert len(arrays["POSITION"]) < 3 * len(part.faces)
        assert np.abs(moved[faces] - part.vertices[part.faces]).max() < 1e-5, part.name


def test_texture_coordinates_have_their_origin_at_the_top(written):
    for part in person().parts:
        arrays, faces, _ = written.part(part.name)
        assert np.abs(arrays["TEXCOORD_0"][faces] - (part.corner_uv * [1, -1] + [0, 1])).max() < 1e-6


def test_pictures_with_holes_are_png_and_cut_out_others_jpeg_and_opaque(written):
    kind, picture = written.picture("hair")
    assert kind == "image/png"
    assert np.array_equal(picture, person().parts[1].texture)
    material = written.part("hair")[2]
    assert (material["alphaMode"], material["alphaCutoff"], material["doubleSided"]) == ("MASK", 0.5, True)
    assert written.picture("body")[0] == "image/jpeg"
    assert "alphaMode" not in written.part("body")[2]
    assert written.part("body")[2]["doubleSided"]


def test_normals_are_of_unit_length_and_point_outwards(written):
    arrays, _, _ = written.part("body")
    assert np.abs(np.linalg.norm(arrays["NORMAL"], axis=1) - 1).max() < 1e-3
    assert ((arrays["POSITION"] - [0, 0.1, 0.03]) * arrays["NORMAL"]).sum(1).mean() > 0


def test_trimesh_opens_the_file():
    scene = trimesh.load(io.BytesIO(glb(person(), skeleton(), {})), file_type="glb")
    assert set(scene.geometry) == {"body", "hair"}


def test_extras_are_kept_with_the_asset_and_the_scene(written):
    assert written.document["asset"]["extras"] == written.document["scenes"][0]["extras"]
    assert len(written.document["asset"]["extras"]["primdiffusion"]["betas"]) == 10


@pytest.mark.parametrize("where", ["joints", "vertices"])
def test_numbers_that_are_none_are_rejected(where):
    mesh, bones = person(), skeleton()
    if where == "joints":
        bones.positions[3] = np.nan
    else:
        mesh.parts[1].vertices[2, 1] = np.inf
    with refused(ValueError, where):
        glb(mesh, bones, {})
