"""COCO annotations of captures: as pycocotools reads them, and against masks, joints and rays cast at the mesh."""

import dataclasses
import json

import numpy as np
import pytest
import torch
import trimesh
from capture_scenes import body_mesh, decoded, save_person
from PIL import Image
from primdiffusion import cli
from primdiffusion.body.model import default_body
from primdiffusion.capture.coco import FACE, KEYPOINTS, keypoints_of, run_lengths, visibility, write_coco
from primdiffusion.capture.poses import built_in_poses
from primdiffusion.capture.reader import open_captures
from primdiffusion.capture.render import RenderJob, render
from primdiffusion.files.regular_files import FileError
from primdiffusion.formats import capture_layout
from primdiffusion.formats.camera_rig import Rig, View
from primdiffusion.formats.joints import JOINT_NAMES
from support.capture_files import faults
from support.errors import refused

NAME = "person_000000"
WRITTEN = ("annotations.json",)


@pytest.fixture(scope="module")
def bodies(tmp_path_factory):
    """Captures of the default body in seven poses from eight sides, 160 pixels wide."""
    root = tmp_path_factory.mktemp("bodies")
    people = {NAME: save_person(root / "people" / NAME / "person.glb", body_mesh())}
    poses = built_in_poses().map(lambda values: values[::3])
    job = RenderJob(people, poses, root / "captures", Rig(count=8, width=160, height=160))
    assert {outcome.status for outcome in render(job)} == {"done"}
    write_coco(open_captures(job.out), {})
    return job.out


def annotations(root) -> dict:
    return json.loads((root / "annotations.json").read_text())


def test_pycocotools_reads_the_rendered_masks_and_boxes(bodies):
    coco = pytest.importorskip("pycocotools.coco").COCO(bodies / "annotations.json")
    mask_tools = pytest.importorskip("pycocotools.mask")
    subject = open_captures(bodies).subject(NAME)
    assert coco.getCatIds(catNms=["person"]) == [1]
    assert len(coco.getImgIds()) == len(coco.getAnnIds(catIds=[1], iscrowd=False)) == 7 * 8
    for image in coco.loadImgs(coco.getImgIds()):
        (annotation,) = coco.loadAnns(coco.getAnnIds(imgIds=image["id"]))
        with Image.open(bodies / image["file_name"]) as picture:
            assert picture.size == (image["width"], image["height"])
        stored = subject.picture("mask", image["frame"], image["camera"])
        assert np.array_equal(coco.annToMask(annotation), stored / 255 > 0.5)
        packed = coco.annToRLE(annotation)
        assert mask_tools.toBbox(packed).tolist() == annotation["bbox"]
        assert mask_tools.area(packed) == annotation["area"]


def test_pycocotools_scores_the_annotations_perfect_against_themselves(bodies):
    coco = pytest.importorskip("pycocotools.coco").COCO(bodies / "annotations.json")
    evaluation = pytest.importorskip("pycocotools.cocoeval")
    own = [{**annotation, "score": 1.0} for annotation in coco.loadAnns(coco.getAnnIds())]
    for kind in ("bbox", "segm", "keypoints"):
        judged = evaluation.COCOeval(coco, coco.loadRes(own), kind)
        judged.evaluate()
        judged.accumulate()
        judged.summarize()
        assert judged.stats[0] == pytest.approx(1)


def test_keypoints_are_within_a_pixel_of_the_projected_joints(bodies):
    with np.load(bodies / NAME / "joints.npz") as noted:
        projected = noted["pixel"]
    written = annotations(bodies)
    (category,) = written["categories"]
    joints = [JOINT_NAMES.index(name) for name in category["keypoints"][5:]]
    assert len(joints) == 12
    for image, annotation in zip(written["images"], written["annotations"], strict=True):
        found = np.reshape(annotation["keypoints"], (17, 3))
        assert (found[:, 2] > 0).all()
        assert annotation["num_keypoints"] == 17
        apart = found[5:, :2] + 0.5 - projected[image["camera"], image["frame"]][joints]
        assert np.abs(apart).max() < 0.01


def test_pose_shape_and_camera_of_an_annotation_give_its_keypoints(bodies):
    written = annotations(bodies)
    image, annotation = written["images"][13], written["annotations"][13]
    smpl = {name: torch.tensor(values) for name, values in annotation["smpl"].items()}
    pose = type(built_in_poses()).from_axis_angle(smpl["pose"], smpl["translation"])
    joints = default_body().shape(smpl["betas"]).pose(pose).joints[:, :3, 3].double().numpy()
    k, r, t = (np.array(image[name]) for name in "KRT")
    pixels, _ = View(k, r, t, image["width"], image["height"]).project(joints)
    found = np.reshape(annotation["keypoints"], (17, 3))[KEYPOINTS.index("left_knee"), :2]
    np.testing.assert_allclose(found + 0.5, pixels[JOINT_NAMES.index("left_knee")], atol=0.01)


def test_visibility_of_limbs_agrees_with_rays_that_leave_the_body_before_the_joint(bodies):
    """A joint is hidden where a ray to it passes through air behind the first surface that it meets.

    Hips and shoulders are left out: from the other side the ray stays inside of the trunk.
    """
    pytest.importorskip("embreex", reason="there is nothing to cast rays with")
    subject = open_captures(bodies).subject(NAME)
    body = default_body().shape(torch.from_numpy(subject.smpl.betas))
    limbs = [place for place, name in enumerate(KEYPOINTS) if name.endswith(("elbow", "wrist", "knee", "ankle"))]
    joints = [JOINT_NAMES.index(KEYPOINTS[place]) for place in limbs]
    written = iter(annotations(bodies)["annotations"])
    found, through_air = [], []
    for frame in range(subject.frames):
        posed = body.pose(subject.smpl.pose(frame))
        mesh = trimesh.Trimesh(posed.vertices.numpy(), default_body().faces.numpy(), process=False)
        for view in subject.views:
            along = posed.joints[joints, :3, 3].double().numpy() - view.position
            origins = np.tile(view.position, (len(joints), 1))
            places, ray, face = mesh.ray.intersects_location(origins, along, multiple_hits=True)
            nearer = np.linalg.norm(places - view.position, axis=1) < np.linalg.norm(along, axis=1)[ray]
            leaves = (mesh.face_normals[face] * along[ray]).sum(1) > 0
            through_air += (np.bincount(ray[nearer & leaves], minlength=len(joints)) > 0).tolist()
            found += (np.array(next(written)["keypoints"][2::3])[limbs] == 1).tolist()
    found, through_air = np.array(found), np.array(through_air)
    assert found.sum() > 20
    assert np.mean(found == through_air) > 0.95
    assert found[through_air].mean() > 0.9


def test_the_face_is_seen_from_the_front_and_hidden_from_behind(bodies):
    subject = open_captures(bodies).subject(NAME)
    written = annotations(bodies)
    for number, image in enumerate(written["images"][:8]):  # close to the T pose
        v = written["annotations"][number]["keypoints"][2::3][:3]
        facing = subject.views[image["camera"]].position[2] / np.linalg.norm(subject.views[image["camera"]].position)
        if facing > 0.8:
            assert v == [2, 2, 2]
        if facing < -0.7:
            assert v == [1, 1, 1]
    nose, left_eye, right_eye, left_ear, right_ear = keypoints_of(subject)[0, :5]
    assert nose[2] > max(left_eye[2], right_eye[2])
    assert min(left_eye[2], right_eye[2]) > max(left_ear[2], right_ear[2])
    assert left_ear[0] > left_eye[0] > nose[0] > right_eye[0] > right_ear[0]


def test_points_before_behind_and_outside():
    view = View(np.array([[10.0, 0, 5], [0, 10, 5], [0, 0, 1]]), np.eye(3), np.zeros(3), 10, 10)
    points = np.tile([0.0, 0, 1], (17, 1))
    points[6] = (0, 0, -1)
    points[7] = (2, 0, 1)
    points[8] = (0, 0, 20)
    points[9] = (np.nan, 0, 1)
    mask, depth = np.full((10, 10), 255, np.uint8), np.full((10, 10), round(0.87 / 0.00025), np.uint16)
    nothing = np.zeros_like(depth)
    pixels, seen = visibility(view, points, [mask, mask], [nothing, depth])
    assert seen == [1, 1, 1, 1, 1, 2, 0, 0, 1, 0, 1, 2, 2, 2, 2, 2, 2]  # 0.13 m behind: wrists hidden, hips not
    assert pixels[5].tolist() == [5, 5]
    assert visibility(view, points, [mask], [nothing])[1] == [2] * 6 + [0, 0, 1, 0] + [2] * 7


@pytest.mark.parametrize("rows", ["10", "01", "11", "00"])
def test_run_lengths_are_of_columns_and_begin_outside(rows):
    mask = np.array([[c == "1" for c in rows], [True, False]])
    assert run_lengths(mask) == {"10": [0, 2, 2], "01": [1, 2, 1], "11": [0, 3, 1], "00": [1, 1, 2]}[rows]
    assert np.array_equal(decoded(run_lengths(mask), 2, 2), mask)


def test_run_lengths_are_those_of_pycocotools():
    tools = pytest.importorskip("pycocotools.mask")
    rng = np.random.default_rng(4)
    masks = [rng.random((17, 23)) < share for share in (0, 0.02, 0.5, 0.98, 1)]
    masks += [np.pad(np.ones((5, 4), bool), ((top, 9 - top), (left, 8 - left))) for top in (0, 9) for left in (0, 8)]
    for mask in masks:
        height, width = mask.shape
        own = tools.frPyObjects({"size": [height, width], "counts": run_lengths(mask)}, height, width)
        assert own == tools.encode(np.asfortranarray(mask, np.uint8))


def test_the_face_is_that_of_the_whole_body(bodies):
    subject = open_captures(bodies).subject(NAME)
    for betas in (subject.smpl.betas, np.linspace(-2, 2, 4, dtype=np.float32)):
        shaped = default_body().to(dtype=torch.float64).shape(torch.from_numpy(betas).double())
        poses = [shaped.pose(subject.smpl.pose(frame).to(dtype=torch.float64)) for frame in range(subject.frames)]
        face = np.stack([posed.vertices.numpy()[list(FACE.values())].mean(1) for posed in poses])
        moved = dataclasses.replace(subject, smpl=dataclasses.replace(subject.smpl, betas=betas))
        joints = np.stack([posed.joints[:, :3, 3].numpy() for posed in poses])
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("primdiffusion.capture.reader._stored_joints", lambda _, joints=joints: {"world": joints})
            np.testing.assert_allclose(keypoints_of(moved)[:, : len(FACE)], face, rtol=0, atol=1e-12)


def test_the_command_writes_the_same_bytes_again_and_rendering_goes_on(root, whole, capsys):
    cli.main(["captures", "coco", str(root)])
    assert WRITTEN[0] in capsys.readouterr().out
    first = [(root / name).read_bytes() for name in WRITTEN]
    before = {path: path.read_bytes() for path in whole.rglob("*") if path.is_file()}
    cli.main(["captures", "coco", str(root)])
    assert [(root / name).read_bytes() for name in WRITTEN] == first
    assert {path.relative_to(root) for path in root.rglob("*") if path.is_file()} == {
        *(path.relative_to(whole) for path in before), *(root.joinpath(name).relative_to(root) for name in WRITTEN)
    }  # fmt: skip
    assert all((root / path.relative_to(whole)).read_bytes() == content for path, content in before.items())
    assert not faults(root)
    capture_layout.claim(root, capture_layout.read_about(root))


def test_attributes_come_from_the_folder_of_people(root):
    people = root.parent / "people"
    (people / NAME / "person.json").write_text(json.dumps({"seed": 0, "attributes": {"outfit": "suit"}}))
    cli.main(["captures", "coco", str(root), "--people", str(people)])
    for one in annotations(root)["annotations"]:
        assert one.get("attributes", {}) == ({"outfit": "suit"} if one["subject"] == NAME else {})


def test_an_image_without_its_subject_has_no_annotation(root):
    Image.new("L", (32, 32)).save(capture_layout.picture_path(root / NAME, "mask", 2, 1))
    write_coco(open_captures(root), {})
    written = annotations(root)
    (alone,) = {image["id"] for image in written["images"]} - {one["image_id"] for one in written["annotations"]}
    assert [written["images"][alone - 1][name] for name in ("subjects", "frame", "camera")] == [[NAME], 1, 2]


def test_the_face_is_unknown_on_another_body(root):
    with np.load(root / NAME / "joints.npz") as noted:
        arrays = dict(noted)
    arrays["world"] = arrays["world"] + np.float32([0, 0.05, 0])
    capture_layout.write_npz(root / NAME / "joints.npz", **arrays)
    write_coco(open_captures(root), {})
    for annotation in annotations(root)["annotations"]:
        face = annotation["keypoints"][: 3 * len(FACE)]
        assert any(face) == (annotation["image_id"] > 12)


def test_the_face_of_a_rig_of_its_own_moves_with_its_head(root):
    before = keypoints_of(open_captures(root).subject(NAME))
    with np.load(root / NAME / "joints.npz") as noted:
        arrays = dict(noted)
    up = np.float32([0, 0.05, 0])
    capture_layout.write_npz(
        root / NAME / "joints.npz", **arrays | {"world": arrays["world"] + up}, fitted=arrays["world"]
    )
    np.testing.assert_allclose(keypoints_of(open_captures(root).subject(NAME)), before + up, atol=1e-5)


def test_unfinished_subjects_are_left_out(root):
    (root / capture_layout.LIST_FILE).write_text(f"{NAME}\n")
    write_coco(open_captures(root), {})
    assert {one["subject"] for one in annotations(root)["annotations"]} == {NAME}
    assert all(image["subjects"] == [NAME] for image in annotations(root)["images"])


@pytest.mark.parametrize("kind", ["depth", "mask", "img"])
def test_captures_without_a_pass_are_refused(root, kind):
    about = json.loads((root / "dataset.json").read_text())
    about["passes"].remove(kind)
    (root / "dataset.json").write_text(json.dumps(about))
    with refused(FileError, f"no {kind}"):
        write_coco(open_captures(root), {})
    assert not any((root / name).exists() for name in WRITTEN)


def test_damage_is_named_and_the_earlier_files_stay(root):
    for name in WRITTEN:
        (root / name).write_text("earlier")
    capture_layout.picture_path(root / "person_000001", "depth", 3, 2).write_bytes(b"no picture")
    with refused(FileError, "0002.png"):
        write_coco(open_captures(root), {})
    (root / NAME / "joints.npz").unlink()
    capture_layout.write_npz(root / NAME / "joints.npz", world=np.zeros((3, 23, 3)))
    with refused(FileError, "joints.npz"):
        write_coco(open_captures(root), {})
    assert [(root / name).read_text() for name in WRITTEN] == ["earlier"]
    assert not list(root.glob(".*"))


def test_captures_over_hdris_are_annotated_in_that_pass(root):
    about = json.loads((root / "dataset.json").read_text())
    about["passes"].append("hdri")
    (root / "dataset.json").write_text(json.dumps(about))
    captures = open_captures(root)
    write_coco(captures, {})
    names = [image["file_name"] for image in annotations(root)["images"]]
    assert names[0] == f"{NAME}/hdri/camera0000/0000.jpg"
    assert all("/hdri/" in name for name in names)
