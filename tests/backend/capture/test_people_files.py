"""Humans read from .glb files: what was written, and whole glTF that holds no human or what no mesh has."""

import json
import struct

import numpy as np
import pytest
from capture_scenes import box_person, save_person
from primdiffusion.capture.people_files import find_people, read_person
from primdiffusion.files.regular_files import FileError
from support.errors import refused

FLOAT, BYTE = 5126, 5120


@pytest.fixture
def person(tmp_path):
    """A file, its JSON and its binary chunk."""
    path = save_person(tmp_path / "person.glb")
    data = path.read_bytes()
    size = int.from_bytes(data[12:16], "little")
    return path, json.loads(data[20 : 20 + size]), data[28 + size :]


def write(path, tree, binary):
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def test_a_persons_file_is_read_as_it_was_written(tmp_path):
    mesh = box_person()
    person = read_person(save_person(tmp_path / "a.glb", mesh))
    assert person.betas.tolist() == [0.0] * 10
    for was, now in zip(mesh.parts, person.mesh.parts, strict=True):
        assert now.name == was.name
        np.testing.assert_allclose(now.vertices[now.faces], was.vertices[was.faces], atol=1e-6)
        np.testing.assert_allclose(now.corner_uv, was.corner_uv, atol=1e-6)
        assert np.array_equal(now.texture, was.texture)
        assert (now.skin_index[:, 0] == was.skin_index[0, 0]).all()


@pytest.mark.parametrize(
    ("edit", "why"),
    [
        (lambda c: c["accessors"][1].update(count=10**9), "not a human"),
        (lambda c: c["bufferViews"][1].update(byteOffset=-8), "not a human"),
        (lambda c: c["nodes"][0].update(name="Hips"), "joints"),
        (lambda c: c["images"][0].update(uri="../../secret.png", bufferView=10**6), "not a human"),
        (lambda c: c["asset"].pop("extras"), "extras"),
        (lambda c: c["asset"]["extras"]["primdiffusion"].update(body="smplx"), "smplx"),
        (lambda c: c["asset"]["extras"]["primdiffusion"].update(betas=[1e6] * 10), "betas"),
        (lambda c: c["nodes"].__setitem__(slice(24, None), []), "0 parts"),
        (lambda c: c["meshes"][0]["primitives"][0].pop("material"), "material"),
    ],
)
def test_files_without_a_human_are_rejected(person, edit, why):
    path, tree, binary = person
    edit(tree)
    write(path, tree, binary)
    with refused(FileError, "person.glb", why):
        read_person(path)


@pytest.mark.parametrize(
    ("name", "kind", "value"),
    [
        ("indices", BYTE, -1), ("indices", FLOAT, np.nan), ("TEXCOORD_0", FLOAT, 1e38), ("WEIGHTS_0", FLOAT, -1),
        ("POSITION", FLOAT, np.inf),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore:invalid value")
def test_numbers_that_no_mesh_has_are_rejected(person, name, kind, value):
    path, tree, binary = person
    primitive = tree["meshes"][0]["primitives"][0]
    about = tree["accessors"][primitive["indices"] if name == "indices" else primitive["attributes"][name]]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[about["type"]]
    values = np.full(about["count"] * width, value, np.float32 if kind == FLOAT else np.int8).tobytes()
    values += bytes(-len(values) % 4)
    tree["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(values)})
    about.update(bufferView=len(tree["bufferViews"]) - 1, componentType=kind, byteOffset=0)
    write(path, tree, binary + values)
    with refused(FileError, "person.glb"):
        read_person(path)


def test_a_small_file_cannot_name_endless_parts(person):
    path, tree, binary = person
    tree["nodes"] += [node for node in tree["nodes"] if "mesh" in node] * 50_000
    write(path, tree, binary)
    with refused(FileError, "100"):
        read_person(path)


def test_materials_of_one_picture_share_a_texture(person):
    path, tree, binary = person
    own = [part.texture for part in read_person(path).mesh.parts]
    assert own[0] is not own[1]
    tree["textures"][1]["source"] = 0
    write(path, tree, binary)
    first, second = (part.texture for part in read_person(path).mesh.parts)
    assert first is second


def test_textures_that_a_file_of_its_size_cannot_have_are_not_decoded(person, monkeypatch):
    path, _, _ = person
    monkeypatch.setattr("primdiffusion.capture.people_files.decoded_bytes", lambda _size: 0)
    monkeypatch.setattr("primdiffusion.capture.people_files.decoded", lambda *_: pytest.fail("decoded"))
    with refused(FileError, "texels"):
        read_person(path)


def test_people_are_found_in_folders_of_their_own(tmp_path):
    for path in ("b/person.glb", "a/person.glb", "c.glb", ".hidden/person.glb"):
        save_person(tmp_path / path)
    assert list(find_people(tmp_path)) == ["a", "b"]
    with refused(FileNotFoundError, "nowhere"):
        find_people(tmp_path / "nowhere")
