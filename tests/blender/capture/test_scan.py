"""Skinned people of other rigs, rests, units and axes: posed as the body is, whatever they came with."""

import json
import struct
from pathlib import Path

import bpy
import numpy as np
import pytest
import scan_fixtures
import synthetic
from blender_primdiffusion.files.regular_files import FileError
from blender_primdiffusion.formats.camera_rig import bounding_sphere
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.rigs import RIGS, map_bones
from blender_primdiffusion.formats.poses.rotation import about_axis
from loaded_scans import BETAS, BODY, MOVE, ROTATIONS, distance_m, load
from support.errors import refused

from blender_primdiffusion.capture.scan import Scan


def bone_heads(scan: Scan) -> np.ndarray:
    """Heads of the posed bones as Blender has them [24, 3], y up; NaN for joints without a bone."""
    heads = np.full((24, 3), np.nan)
    for name, joint in zip(scan.skeleton.names, scan.skeleton.joint, strict=True):
        if joint >= 0:
            heads[joint] = scan.armature.matrix_world @ scan.armature.pose.bones[name].head
    return heads @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def quarter(axis: int) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = about_axis(axis, np.pi / 2)
    return matrix


CASES = {
    "Mixamo, T, glb": ("MIXAMO", ".glb", False, np.eye(4)),
    "RenderPeople, A, centimetres, fbx": ("RENDERPEOPLE", ".fbx", True, np.diag([100.0, 100, 100, 1])),
    "Unreal, A, lying, fbx": ("UNREAL", ".fbx", True, quarter(0)),
    "Rigify, A, tenfold too small, glb": ("RIGIFY", ".glb", True, np.diag([0.1, 0.1, 0.1, 1])),
    "SMPL's names, A, facing left, millimetres, fbx": ("OWN", ".fbx", True, quarter(2) @ np.diag([1e3, 1e3, 1e3, 1])),
}


@pytest.mark.parametrize("case", CASES)
def test_a_rig_is_posed_as_the_body_is(tmp_path, empty_scene, case):
    names, ending, has_a_rest, placed = CASES[case]
    rest = scan_fixtures.a_pose() if has_a_rest else None
    _, armature = scan_fixtures.person(BODY, BETAS, rest, getattr(scan_fixtures, names))
    scan_fixtures.move([armature], placed)
    scan = load(scan_fixtures.save(tmp_path / f"anna{ending}"))
    joints = scan.pose(ROTATIONS, MOVE)
    vertices, expected, _ = BODY.pose(BETAS, ROTATIONS, MOVE)
    assert np.linalg.norm(joints - expected, axis=-1).max() < 0.005
    heads = bone_heads(scan)
    assert np.nanmax(np.abs(heads - joints)) < 1e-4
    assert np.isfinite(heads).all(1).sum() >= 22
    off = distance_m(scan, vertices)
    assert off.mean() < 0.006  # the hands, which other rigs do not bend at the knuckles, are off by more
    fitted = BODY.pose(scan.betas, ROTATIONS, MOVE)[1]
    assert np.linalg.norm(fitted - expected, axis=-1).max() < 0.01
    assert any("mm off on average" in note for note in scan.notes) or any("file tells" in note for note in scan.notes)


@pytest.mark.any_blender
def test_units_and_axes_that_were_corrected_are_reported(tmp_path, empty_scene):
    _, armature = scan_fixtures.person(BODY, BETAS, None, scan_fixtures.MIXAMO)
    scan_fixtures.move([armature], quarter(0) @ np.diag([10.0, 10, 10, 1]))
    scan = load(scan_fixtures.save(tmp_path / "anna.glb"))
    notes = "; ".join(scan.notes)
    assert "scaled by 0.1: it is ten times too large" in notes
    assert "-y was up after import: turned upright" in notes
    assert "bones as Mixamo names them" in notes


def test_bounds_are_those_of_what_blender_draws(tmp_path, empty_scene):
    scan_fixtures.person(BODY, BETAS, scan_fixtures.a_pose(), scan_fixtures.UNREAL)
    scan = load(scan_fixtures.save(tmp_path / "anna.fbx"))
    outermost = scan.bounds(ROTATIONS[None], MOVE[None])
    scan.pose(ROTATIONS, MOVE)
    seen = scan_fixtures.evaluated(scan.objects)
    np.testing.assert_allclose(outermost.min(0), seen.min(0), atol=2e-5)
    np.testing.assert_allclose(outermost.max(0), seen.max(0), atol=2e-5)
    np.testing.assert_allclose(bounding_sphere(outermost)[1], bounding_sphere(seen)[1], atol=2e-5)


def own_person(path: Path) -> Path:
    """A .glb as the backend writes people: SMPL's joints at rest, betas in the extras."""
    scan_fixtures.person(BODY, BETAS)
    scan_fixtures.save(path)
    content = path.read_bytes()
    length = struct.unpack("<I", content[12:16])[0]
    about = json.loads(content[20 : 20 + length])
    about["asset"]["extras"] = {"primdiffusion": {"betas": BETAS.tolist(), "body": "default", "seed": 3}}
    written = json.dumps(about).encode()
    written += b" " * (-len(written) % 4)
    rest = content[20 + length :]
    path.write_bytes(
        struct.pack("<4sIII4s", b"glTF", 2, 20 + len(written) + len(rest), len(written), b"JSON") + written + rest
    )
    return path


def test_our_own_people_are_posed_exactly(tmp_path, empty_scene):
    scan = load(own_person(tmp_path / "person_000003" / "person.glb"))
    assert scan.name == "person_000003"
    np.testing.assert_array_equal(scan.betas, BETAS)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        rotations, move = synthetic.random_rotations(rng, 24), rng.normal(0, 1, 3)
        joints = scan.pose(rotations, move)
        vertices, expected, _ = BODY.pose(BETAS, rotations, move)
        np.testing.assert_allclose(joints, expected, atol=5e-5)
        np.testing.assert_allclose(bone_heads(scan), expected, atol=5e-5)
        assert distance_m(scan, vertices).max() < 5e-5


@pytest.mark.any_blender
def test_removing_a_scan_leaves_nothing_and_keeps_what_was_there(tmp_path, empty_scene):
    path = own_person(tmp_path / "p.glb")
    kept = bpy.data.objects.new("kept", bpy.data.meshes.new("kept"))
    scan = load(path)
    assert len(bpy.data.objects) > 1
    scan.remove()
    assert list(bpy.data.objects) == [kept]
    assert [len(getattr(bpy.data, kind)) for kind in ("meshes", "armatures", "materials", "images")] == [1, 0, 0, 0]


@pytest.mark.any_blender
def test_groups_of_fingers_belong_to_the_wrist(tmp_path, empty_scene):
    scan_fixtures.person(BODY, BETAS, None, scan_fixtures.MIXAMO)
    scan = load(scan_fixtures.save(tmp_path / "anna.glb"))
    assert scan.joint_of_group("mixamorig:LeftHandMiddle1") == JOINT_NAMES.index("left_wrist")
    assert scan.joint_of_group("mixamorig:Hips") == 0
    assert scan.joint_of_group("nothing") is None


def test_an_animated_person_with_a_bone_glued_to_its_parent_is_still_posed(tmp_path, empty_scene):
    _, armature = scan_fixtures.person(BODY, BETAS, None, scan_fixtures.UNREAL)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    root = armature.data.edit_bones.new("root")
    root.head, root.tail = (0, 0, -1.2), armature.data.edit_bones["pelvis"].head
    armature.data.edit_bones["pelvis"].parent = root
    armature.data.edit_bones["pelvis"].use_connect = True
    bpy.ops.object.mode_set(mode="OBJECT")
    armature.pose.bones["calf_l"].rotation_quaternion = (0.7, 0.7, 0, 0)
    armature.pose.bones["calf_l"].keyframe_insert("rotation_quaternion", frame=1)
    scan = load(scan_fixtures.save(tmp_path / "anna.glb"))
    joints = scan.pose(ROTATIONS, MOVE)
    assert np.linalg.norm(joints - BODY.pose(BETAS, ROTATIONS, MOVE)[1], axis=-1).max() < 0.005
    assert np.nanmax(np.abs(bone_heads(scan) - joints)) < 1e-4


@pytest.mark.any_blender
def test_a_lamp_and_a_mesh_that_nothing_moves_are_left_out_and_reported(tmp_path, empty_scene):
    scan_fixtures.person(BODY, BETAS, None, scan_fixtures.MIXAMO)
    bpy.ops.mesh.primitive_cube_add()
    bpy.ops.object.light_add(type="POINT")
    scan = load(scan_fixtures.save(tmp_path / "anna.glb"))
    assert len(scan.objects) == 1
    assert "left out, as no bone moves it: Cube" in scan.notes
    assert not any(obj.type == "LIGHT" for obj in bpy.data.objects)


@pytest.mark.any_blender
@pytest.mark.parametrize("rig", sorted(set(RIGS) - {"Daz", "MocapNET", "Biovision"}))
def test_every_rigs_own_names_are_known_with_any_prefix(rig):
    bones = [
        f"pre_{name.split('|')[0].format(l=side[0], left=side)}"
        for part, name in RIGS[rig].items()
        for side in (("left", "right") if "{" in name else ("left",))
    ]
    found = map_bones(["twist_01", *bones, "jaw"])
    assert found.rig == rig
    assert len(found.joints) >= 22


@pytest.mark.any_blender
def test_names_that_are_no_rigs_are_rejected():
    with refused(ValueError, "pelvis"):
        map_bones(["a", "b"])
    with refused(ValueError, "left_knee"):
        map_bones([name for name in JOINT_NAMES if name != "left_knee"])


def rigged(change=lambda mesh, armature: None, count: int = 1, names=scan_fixtures.MIXAMO, name: str = "anna.glb"):
    """What writes people whose mesh or armature is changed."""

    def write(folder: Path) -> Path:
        for _ in range(count):
            change(*scan_fixtures.person(BODY, BETAS, None, names))
        return scan_fixtures.save(folder / name)

    return write


def scaled(*sides: float):
    return rigged(lambda _, armature: scan_fixtures.move([armature], np.diag([*sides, 1])))


def holding(name: str, content: bytes):
    def write(folder: Path) -> Path:
        (folder / name).write_bytes(content)
        return folder / name

    return write


def glb_of(content: dict) -> bytes:
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text


NONSENSE = b"glTF\x02\x00\x00\x00 nonsense" * 20
REFUSED = {
    "unknown bones": (rigged(names={name: f"Bone {name[::-1]}" for name in JOINT_NAMES}), "left_hip"),
    "a size that no unit explains": (scaled(0.2, 0.2, 0.2), "0.3"),
    "a skeleton whose scale bends turns": (scaled(1, 1, 1.3), "scaled unevenly"),
    "two people": (rigged(count=2), "2 skeletons"),
    "no surface": (rigged(lambda mesh, _: bpy.data.objects.remove(mesh), name="bones.fbx"), "bones.fbx"),
    "a lost vertex": (rigged(lambda mesh, _: setattr(mesh.data.vertices[0].co, "x", 1e6)), "anna.glb"),
    "a node that is not there": (
        holding("a.glb", glb_of({"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [7]}]})), "a.glb",
    ),
    **{f"a damaged {ending}": (holding(f"a.{ending}", NONSENSE), f"a.{ending}") for ending in ("glb", "fbx", "gltf")},
}  # fmt: skip


@pytest.mark.any_blender
@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_person_is_named_and_leaves_nothing(tmp_path, empty_scene, case):
    write, named = REFUSED[case]
    path = write(tmp_path)
    with refused(FileError, str(path), named):
        load(path)
    assert len(bpy.data.objects) == 0
