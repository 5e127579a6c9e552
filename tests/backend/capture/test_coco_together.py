"""Humans that stand together: places, cameras, and images composed of them."""

import json
import shutil

import numpy as np
import pytest
import torch
from capture_scenes import decoded, small_job
from PIL import Image
from primdiffusion import cli
from primdiffusion.capture.coco import KEYPOINTS, compose, drawn_box, groups, uncovered, write_coco
from primdiffusion.capture.people_files import read_person
from primdiffusion.capture.poses import built_in_poses, turned
from primdiffusion.capture.reader import open_captures
from primdiffusion.capture.render import render, set_up_together, srgb_bytes
from primdiffusion.files.regular_files import FileError
from primdiffusion.formats import capture_layout
from primdiffusion.formats.camera_rig import GAP, Rig, places
from primdiffusion.geometry.image import decode_srgb
from primdiffusion.raster.textures import LINEAR_OF_BYTE
from support.errors import refused

NAMES = [f"person_{number:06d}" for number in range(5)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Two groups of three and two boxes, in three poses from four sides."""
    root = tmp_path_factory.mktemp("together")
    small_job(root, people=5)
    command = ["captures", "render", "--people", str(root / "people"), "--out", str(root / "captures")]
    cli.main([*command, "--together", "3", "--pose-count", "3", "--cameras", "4", "--size", "96"])
    return root / "captures"


@pytest.fixture
def root(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "captures")
    return tmp_path / "captures"


def test_places_are_apart_and_begin_in_the_middle():
    rng = np.random.default_rng(0)
    for count in range(1, 9):
        radii = rng.uniform(0.3, 1, count)
        found = places(radii, rng)
        assert found[0].tolist() == [0, 0]
        apart = np.linalg.norm(found[:, None] - found, axis=-1) - radii[:, None] - radii
        assert (apart[~np.eye(count, dtype=bool)] >= GAP).all()
        assert np.abs(found).max() < 2 * radii.sum() + 1


def test_turning_by_a_half_shows_the_back():
    poses = built_in_poses().map(lambda values: values[:2])
    back = turned(poses, np.array([np.pi, 0.0]))
    from_behind = poses.joint_rotation[0, 0, :, 2] * torch.tensor([-1, 1, -1])
    assert np.allclose(back.joint_rotation[0, 0, :, 2], from_behind, atol=1e-5)
    assert np.allclose(back.joint_rotation[1], poses.joint_rotation[1])
    assert np.allclose(back.joint_rotation[0, 1:], poses.joint_rotation[0, 1:])


def test_bodies_stand_on_the_floor_apart_in_front_of_the_same_cameras(whole):
    people = [read_person(whole.parent / "people" / name / "person.glb") for name in NAMES[:3]]
    poses = built_in_poses().map(lambda values: values[:3])
    rig = Rig(count=4, width=96, height=96)
    setups = [set_up_together(people, own, poses, rig, np.random.default_rng(5)) for own in range(3)]
    for first in setups:
        for view, same in zip(first.views, setups[0].views, strict=True):
            assert np.array_equal(view.rotation, same.rotation)
            assert np.array_equal(view.translation, same.translation)
    bodies = [[setup.person.points(matrices) for matrices in setup.skinning] for setup in setups]
    for frame in range(3):
        for number in range(3):
            points = bodies[number][frame]
            assert points[:, 1].min() == pytest.approx(0, abs=1e-5)
            for other in range(number):
                apart = points[:, None, [0, 2]] - bodies[other][frame][None][..., [0, 2]]
                assert np.linalg.norm(apart, axis=-1).min() > GAP - 1e-5
            for view in setups[0].views:
                pixels, depth = view.project(points)
                assert (depth > 0).all()
                assert (pixels > 0).all()
                assert (pixels < 96).all()
    assert not np.allclose(setups[1].poses.translation[0], setups[1].poses.translation[1])


def test_groups_are_found_by_their_cameras(root):
    captures = open_captures(root)
    assert [[subject.name for subject in members] for members in groups(captures)] == [NAMES[:3], NAMES[3:]]
    (root / capture_layout.LIST_FILE).write_text("\n".join([NAMES[0], NAMES[2], NAMES[3]]))
    assert [[subject.name for subject in members] for members in groups(open_captures(root))] == [
        [NAMES[0], NAMES[2]], [NAMES[3]],
    ]  # fmt: skip


def test_humans_of_other_captures_are_alone_even_with_the_same_cameras(root):
    about = json.loads((root / "dataset.json").read_text())
    assert about.pop("together") == 3
    (root / "dataset.json").write_text(json.dumps(about))
    assert [len(members) for members in groups(open_captures(root))] == [1] * 5


def test_masks_of_a_group_are_what_nearer_humans_leave(root):
    write_coco(open_captures(root), {})
    written = json.loads((root / "annotations.json").read_text())
    captures, hidden = open_captures(root), 0
    assert [image["subjects"] for image in written["images"]] == [NAMES[:3]] * 12 + [NAMES[3:]] * 12
    for image in written["images"]:
        found = [one for one in written["annotations"] if one["image_id"] == image["id"]]
        shown = [decoded(one["segmentation"]["counts"], *one["segmentation"]["size"]) for one in found]
        assert np.sum(shown, axis=0).max() == 1
        where = image["frame"], image["camera"]
        stored = {name: captures.subject(name).pictures(("mask", "depth"), *where) for name in image["subjects"]}
        everyone = np.array([np.where(one["depth"] > 0, one["depth"], 65535) for one in stored.values()])
        for annotation, mask in zip(found, shown, strict=True):
            own = stored[annotation["subject"]]
            assert np.array_equal(
                decoded(annotation["amodal"]["counts"], *annotation["amodal"]["size"]), own["mask"] >= 128
            )
            assert not (mask & (own["mask"] < 128)).any()
            nearest = (own["depth"] > 0) & (own["depth"] == everyone.min(0))
            inside = np.min([(one["mask"] == 0) | (one["mask"] == 255) for one in stored.values()], axis=0)
            assert np.array_equal((mask & nearest)[inside], nearest[inside])
            hidden += ((own["mask"] >= 128) & ~mask).sum()
    assert hidden > 50


def test_a_joint_behind_another_human_is_hidden(root):
    write_coco(open_captures(root), {})
    written, captures = json.loads((root / "annotations.json").read_text()), open_captures(root)
    for annotation in written["annotations"]:
        image = written["images"][annotation["image_id"] - 1]
        keypoints = np.reshape(annotation["keypoints"], (17, 3))
        others = [name for name in image["subjects"] if name != annotation["subject"]]
        with np.load(root / annotation["subject"] / "joints.npz") as noted:
            depth = noted["depth"][image["camera"], image["frame"]]
        x, y, v = keypoints[KEYPOINTS.index("left_hip")]
        for name in others:
            front = captures.subject(name).picture("depth", image["frame"], image["camera"])[int(y + 0.5), int(x + 0.5)]
            if front and front * 0.00025 < depth[1] - 0.5:
                assert v == 1


def test_nearer_layers_cover_farther_ones_whatever_their_order():
    images = [np.full((1, 2, 3), 128, np.uint8), np.full((1, 2, 3), 255, np.uint8)]
    masks = [np.array([[255, 128]], np.uint8), np.array([[255, 255]], np.uint8)]
    depths = [np.array([[4000, 0]], np.uint16), np.array([[8000, 8000]], np.uint16)]
    half = 127 / 255
    shares, turned = uncovered(masks, depths, [1.0, 2.0]), uncovered(masks[::-1], depths[::-1], [2.0, 1.0])
    assert np.allclose(shares, [[[1, 1]], [[0, half]]])
    assert np.allclose(turned, [[[0, half]], [[1, 1]]])
    image, same = compose(images, shares), compose(images[::-1], turned)
    assert np.array_equal(image, same)
    assert image[0, 0].tolist() == [128] * 3
    assert decode_srgb(image[0, 1] / 255) == pytest.approx(float(decode_srgb(np.array(128 / 255))) + half, abs=0.004)


def random_passes(rng, humans, size=(40, 50)):
    """Images, masks, depths and distances of blobs with soft edges, some at the same depth or without one."""
    found = []
    for _ in range(humans):
        rows, columns = np.indices(size)
        far = np.hypot(rows - rng.uniform(0, size[0]), columns - rng.uniform(0, size[1]))
        mask = np.clip((rng.uniform(3, 15) - far) * 60, 0, 255).astype(np.uint8)
        depth = np.where(mask > rng.integers(0, 255), rng.integers(3990, 4010, size), 0).astype(np.uint16)
        image = np.where(mask[..., None] > 0, rng.integers(0, 256, (*size, 3)), 0).astype(np.uint8)
        found.append((image, mask, depth, rng.uniform(0.9, 1.1)))
    return zip(*found, strict=True)


def test_shares_and_images_are_those_of_sorting_all_pixels():
    rng = np.random.default_rng(8)
    for humans in (1, 2, 3, 8):
        for _ in range(5):
            images, masks, depths, distances = random_passes(rng, humans)
            filled = [np.where(depth > 0, depth * 0.00025, far) for depth, far in zip(depths, distances, strict=True)]
            order = np.stack(filled).argsort(axis=0, kind="stable")
            left = np.take_along_axis(1 - np.stack(masks) / np.float32(255), order, axis=0)
            left = np.cumprod(np.concatenate([np.ones((1, *left.shape[1:]), np.float32), left[:-1]]), axis=0)
            expected = left.copy()
            np.put_along_axis(expected, order, left, axis=0)
            shares = uncovered(masks, depths, distances)
            assert np.array_equal(shares, expected)
            linear = sum(share[..., None] * LINEAR_OF_BYTE[image] for share, image in zip(shares, images, strict=True))
            assert np.array_equal(compose(images, shares), srgb_bytes(np.minimum(linear, 1)))


def test_outside_of_the_box_there_is_nothing():
    rng = np.random.default_rng(9)
    for humans in (1, 3):
        images, masks, depths, distances = random_passes(rng, humans)
        box = drawn_box([*images, *masks])
        whole = compose(images, uncovered(masks, depths, distances))
        shares = uncovered([mask[box] for mask in masks], [depth[box] for depth in depths], distances)
        assert whole[box].size < whole.size
        assert np.array_equal(compose([image[box] for image in images], shares), whole[box])
        whole[box] = 0
        assert not whole.any()
    empty = np.zeros((4, 5), np.uint8)
    assert empty[drawn_box([np.zeros((4, 5, 3), np.uint8), empty])].size == 0


def test_all_bytes_come_back_from_linear_light():
    assert np.array_equal(srgb_bytes(LINEAR_OF_BYTE), np.arange(256))


def test_a_group_over_black_is_composed_and_a_single_human_is_not(root):
    (root / capture_layout.LIST_FILE).write_text("\n".join([NAMES[0], NAMES[1], NAMES[3]]))
    write_coco(open_captures(root), {})
    images = json.loads((root / "annotations.json").read_text())["images"]
    assert images[0]["file_name"] == f"composed/{NAMES[0]}/img/camera0000/0000.jpg"
    assert images[-1]["file_name"] == f"{NAMES[3]}/img/camera0003/0002.jpg"
    stored = [np.asarray(Image.open(root / name / "img/camera0000/0000.jpg")).astype(int) for name in NAMES[:2]]
    shown = np.asarray(Image.open(root / images[0]["file_name"])).astype(int)
    assert np.abs(shown - np.maximum(*stored)).mean() < 6


def test_a_picture_of_a_group_that_is_missing_is_rendered_again_to_the_same_bytes(root, whole):
    job_root = root.parent
    shutil.copytree(whole.parent / "people", job_root / "people")
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    capture_layout.picture_path(root / NAMES[1], "depth", 2, 1).unlink()
    (root / NAMES[1] / capture_layout.COMPLETE_FILE).unlink()
    command = ["captures", "render", "--people", str(job_root / "people"), "--out", str(root), "--pose-count", "3"]
    cli.main([*command, "--cameras", "4", "--size", "96", "--together", "3", "--shard", "1/5"])
    after = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    assert all(after[path] == content for path, content in before.items() if "report" not in path.name)


@pytest.mark.parametrize(
    "words", [["--together", "0"], ["--together", "9"], ["--together", "2", "--released-reference"]]
)
def test_groups_that_cannot_be_are_refused(tmp_path, fails, words):
    small_job(tmp_path, people=2)
    line = ("captures", "render", "--people", tmp_path / "people", "--out", tmp_path / "out")
    assert "together" in fails(*line, *words).err
    assert not (tmp_path / "out").exists()


def test_captures_of_single_humans_do_not_continue_as_groups(tmp_path):
    job = small_job(tmp_path, people=2, frames=1)
    assert {outcome.status for outcome in render(job)} == {"done"}
    with refused(FileError, "together"):
        list(render(small_job(tmp_path, people=2, frames=1, together=(job.people,))))
