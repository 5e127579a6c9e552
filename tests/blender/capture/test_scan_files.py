"""Folders of scans: who is in them, by what name, with which colours."""

from pathlib import Path

import bpy
import numpy as np
import pytest
import scan_fixtures
from blender_primdiffusion.files.regular_files import FileError
from loaded_scans import BETAS, BODY, load
from support.errors import refused

from blender_primdiffusion.capture.registration import unit_of
from blender_primdiffusion.capture.scan_files import find_scans, own_betas
from blender_primdiffusion.capture.surfaces import choose_picture

pytestmark = pytest.mark.any_blender


def touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")


def test_a_folder_of_folders_and_files_is_searched(tmp_path):
    touch(
        tmp_path / "people" / "person_000000" / "person.glb", tmp_path / "people" / "person_000001" / "person.glb",
        tmp_path / "rp_anna" / "rp_anna_rigged_001.fbx", tmp_path / "rp_anna" / "tex" / "rp_anna_dif.jpg",
        tmp_path / "plain.OBJ", tmp_path / "plain.npz", tmp_path / ".hidden" / "a.glb", tmp_path / "notes.txt",
    )  # fmt: skip
    found = find_scans(tmp_path)
    assert [scan.name for scan in found] == ["person_000000", "person_000001", "plain", "rp_anna_rigged_001"]
    assert found[2].parameters == tmp_path / "plain.npz"
    assert found[3].parameters is None


def test_linked_folders_are_searched_once(tmp_path):
    touch(tmp_path / "far" / "person_000000" / "person.glb")
    (tmp_path / "near").mkdir()
    (tmp_path / "near" / "person_000000").symlink_to(tmp_path / "far" / "person_000000", target_is_directory=True)
    (tmp_path / "near" / "round").symlink_to(tmp_path / "near", target_is_directory=True)
    assert [scan.name for scan in find_scans(tmp_path / "near")] == ["person_000000"]


def test_names_are_made_fit_for_folders_and_unlike_each_other(tmp_path):
    touch(
        tmp_path / "a" / "Ann Müller.glb",
        tmp_path / "b" / "ann-m_ller.glb",
        tmp_path / "c" / "Ann M.ller.glb",
        tmp_path / "d" / "_x_.glb",
        tmp_path / "e" / "Ann_M_ller.glb",
        tmp_path / "f" / "--python=x.glb",
    )
    names = [scan.name for scan in find_scans(tmp_path)]
    assert names == ["Ann_M_ller", "ann-m_ller", "Ann_M.ller", "x", "Ann_M_ller_2", "python_x"]


def test_of_one_person_in_several_formats_one_counts(tmp_path):
    touch(tmp_path / "a.obj", tmp_path / "a.fbx", tmp_path / "b.obj")
    assert [scan.path.name for scan in find_scans(tmp_path)] == ["a.fbx", "b.obj"]


def test_the_released_parameters_and_a_lone_npz_are_found(tmp_path):
    released = tmp_path / "s1" / "outputs_re_fitting" / "refit_smpl_2nd_plain.npz"
    touch(tmp_path / "s1" / "mesh.obj", released, tmp_path / "s2" / "mesh.obj", tmp_path / "s2" / "smpl_param.npz")
    assert [scan.parameters for scan in find_scans(tmp_path)] == [released, tmp_path / "s2" / "smpl_param.npz"]


def test_folders_and_files_without_scans_are_named(tmp_path):
    with refused(FileError):
        find_scans(tmp_path / "none")
    with refused(FileError):
        find_scans(tmp_path)
    touch(tmp_path / "people" / "person_000007" / "person.human.safetensors")
    with refused(FileError, ".glb"):
        find_scans(tmp_path / "people")
    touch(tmp_path / "a.blend")
    with refused(FileError):
        find_scans(tmp_path / "a.blend")


@pytest.mark.parametrize("content", [b"", b"glTF", b"glTF\x02\0\0\0\xff\xff\xff\xff\xff\xff\xff\xffJSON", b"{}" * 30])
def test_files_that_are_not_ours_have_no_betas(tmp_path, content):
    (tmp_path / "a.glb").write_bytes(content)
    assert own_betas(tmp_path / "a.glb") is None


@pytest.mark.parametrize(
    ("height", "scale"), [(1.7, 1), (0.55, 1), (172, 0.01), (1720, 0.001), (17.2, 0.1), (0.172, 10), (0.0172, 100)]
)
def test_people_are_between_half_a_metre_and_two_and_a_half(height, scale):
    assert unit_of(height, "x") == scale


@pytest.mark.parametrize("height", [0.0, 0.3, 3.5, 1e6, float("nan")])
def test_other_heights_are_rejected(height):
    with refused(FileError):
        unit_of(height, "x")


@pytest.mark.parametrize(
    ("scan", "pictures", "chosen"),
    [
        ("rp_anna_rigged_001_ue4.fbx", ["rp_anna_dif.jpg", "rp_anna_norm.jpg", "rp_bob_dif.jpg"], "rp_anna_dif.jpg"),
        ("rp_anna_rigged_001.fbx", ["rp_anna_rigged_001_norm.png", "rp_anna_rigged_001_dif.png"],
         "rp_anna_rigged_001_dif.png"),
        ("0007.obj", ["0007.png", "0008.png"], "0007.png"),
        ("mesh.obj", ["mesh_albedo.jpg", "mesh_gloss.jpg"], "mesh_albedo.jpg"),
        ("rp_anna_rigged_001.fbx", ["rp_bob_dif.jpg"], None),
        ("anna.fbx", ["anna_norm.jpg", "background.png"], None),
    ],
)  # fmt: skip
def test_a_texture_is_chosen_by_its_name(scan, pictures, chosen):
    found = choose_picture(Path(scan), [Path(name) for name in pictures])
    assert (found.name if found else None) == chosen


def base_image(obj: bpy.types.Object) -> str:
    nodes = obj.material_slots[0].material.node_tree.nodes
    shader = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    return Path(shader.inputs["Base Color"].links[0].from_node.image.filepath).name


def test_a_texture_beside_the_file_is_shown_and_reported(tmp_path, empty_scene):
    scan_fixtures.person(BODY, BETAS, None, scan_fixtures.RENDERPEOPLE)
    path = scan_fixtures.save(tmp_path / "rp_anna_rigged_001.fbx")
    scan_fixtures.checker(tmp_path / "tex" / "rp_anna_dif.png")
    scan_fixtures.checker(tmp_path / "tex" / "rp_anna_norm.png")
    scan = load(path)
    assert "texture found beside it: rp_anna_dif.png" in scan.notes
    assert base_image(scan.objects[0]) == "rp_anna_dif.png"


def test_a_texture_whose_path_is_another_computers_is_found_by_its_name(tmp_path, empty_scene):
    picture = scan_fixtures.checker(tmp_path / "far" / "colours of anna.png")
    scan_fixtures.person(BODY, BETAS, None, scan_fixtures.MIXAMO, picture)
    path = scan_fixtures.save(tmp_path / "here" / "anna.fbx", path_mode="ABSOLUTE")
    (tmp_path / "here" / "textures").mkdir()
    (tmp_path / "far" / "colours of anna.png").rename(tmp_path / "here" / "textures" / "colours of anna.png")
    (tmp_path / "far").rmdir()
    scan = load(path)
    assert any(note.startswith("texture found") for note in scan.notes)
    assert base_image(scan.objects[0]) == "colours of anna.png"


def test_a_scan_without_a_texture_is_reported(tmp_path, empty_scene):
    scan_fixtures.person(BODY, BETAS, None, scan_fixtures.MIXAMO)
    scan = load(scan_fixtures.save(tmp_path / "anna.glb"))
    assert "no texture (skin): drawn in its base colour" in scan.notes


def test_vertex_colours_stand_in_for_a_texture(tmp_path, empty_scene):
    mesh, _ = scan_fixtures.person(BODY, BETAS, None, scan_fixtures.MIXAMO)
    colours = mesh.data.color_attributes.new("Col", "BYTE_COLOR", "CORNER")
    values = np.tile([1.0, 0.2, 0.1, 1.0], (len(mesh.data.loops), 1)).astype(np.float32)
    colours.data.foreach_set("color", values.ravel())
    scan = load(scan_fixtures.save(tmp_path / "anna.fbx"))
    assert "no texture: drawn in its vertex colours" in scan.notes
    nodes = scan.objects[0].material_slots[0].material.node_tree.nodes
    shader = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    assert shader.inputs["Base Color"].links[0].from_node.type == "VERTEX_COLOR"
