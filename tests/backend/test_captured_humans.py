"""Generated humans in captures: against rays cast at their boxes, as pycocotools reads them, and as files go on."""

import json

import numpy as np
import pytest
import torch
import trimesh
from capture_scenes import save_person
from PIL import Image
from primdiffusion import cli
from primdiffusion.capture.poses import built_in_poses
from primdiffusion.capture.reader import open_captures
from primdiffusion.capture.render import set_up_capture, set_up_together
from primdiffusion.captured_humans import VolumetricPerson, find_subjects, read_subject, renderer_name
from primdiffusion.formats import capture_layout
from primdiffusion.formats.camera_rig import Rig
from primdiffusion.human import Human, place
from primdiffusion.human_file import save_human
from primdiffusion.primitives.primitives import K, Payload, S
from support.capture_files import faults
from support.errors import refused

SIZE, FRAMES, CAMERAS = 96, 2, 3
COLOUR = (0.8, 0.2, 0.1)


def dense_human(density: float = 2e4, betas=(1.0, -1.0)) -> Human:
    """All boxes full of one colour."""
    rgb = torch.tensor(COLOUR)[None, :, None, None, None].expand(K, 3, S, S, S).clone()
    shape = torch.zeros(10)
    shape[: len(betas)] = torch.tensor(betas)
    return Human(Payload(rgb, torch.full((K, S, S, S), density), torch.ones(K, 3)), shape, {})


def save(path, **more) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    save_human(path, dense_human(**more))


def words(root, *more: str) -> list[str]:
    about = ["--pose-count", str(FRAMES), "--cameras", str(CAMERAS), "--size", str(SIZE)]
    return ["captures", "render", "--people", str(root / "people"), "--out", str(root / "captures"), *about, *more]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A generated human and a mesh, apart."""
    root = tmp_path_factory.mktemp("humans")
    save_person(root / "people" / "box" / "person.glb")
    save(root / "people" / "ada.human")
    cli.main(words(root))
    return root


def everything(root) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def poses():
    return built_in_poses().map(lambda values: values[:FRAMES])


def hit(boxes, scale: float, view) -> np.ndarray:
    """Depth of the first of the scaled boxes that the ray through each pixel's centre hits; inf for none."""
    meshes = []
    for centre, axes, half in zip(boxes.position, boxes.rotation, boxes.half_extent, strict=True):
        placed = np.eye(4)
        placed[:3, :3], placed[:3, 3] = axes.numpy(), centre.numpy()
        meshes.append(trimesh.creation.box(2 * scale * half.numpy(), placed))
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    rays = np.stack([columns, rows, np.ones_like(rows)], -1).reshape(-1, 3) @ np.linalg.inv(view.intrinsics).T
    origins = np.tile(view.position, (len(rays), 1))
    at, ray, _ = trimesh.util.concatenate(meshes).ray.intersects_location(
        origins, rays @ view.rotation, multiple_hits=False
    )
    found = np.full(len(rays), np.inf)
    found[ray] = (at @ view.rotation.T + view.translation)[:, 2]
    return found.reshape(SIZE, SIZE)


def test_depth_and_mask_are_what_rays_cast_at_the_boxes_hit():
    """Density fades towards the faces of a box: the surface is between a box of 0.8 of its size and the whole one."""
    human, rig = dense_human(), Rig(count=CAMERAS, width=SIZE, height=SIZE)
    setup = set_up_capture(VolumetricPerson(human), poses(), rig)
    for frame, camera in ((0, 0), (1, 1), (1, 2)):
        view, pose = setup.views[camera], poses().map(lambda values, frame=frame: values[frame])
        boxes = place(human, pose)  # by the pose, not by matrices
        outer, inner = hit(boxes, 1.0, view), hit(boxes, 0.8, view)
        drawn = setup.person.posed(setup.skinning[frame])(view, 1)
        seen, sure = np.isfinite(drawn.depth), np.isfinite(inner)
        assert sure.sum() > 1500
        assert np.isfinite(outer[seen]).all()
        assert seen[sure].mean() > 0.995
        assert np.array_equal(drawn.alpha >= 0.5, seen)
        assert (drawn.depth[seen] > outer[seen] - 0.001).all()
        assert (drawn.depth - inner)[seen & sure].max() < 0.05
        assert (drawn.depth < inner + 0.005)[seen & sure].mean() > 0.99
        assert np.median((drawn.depth - outer)[seen]) < 0.01


def test_more_samples_average_the_edges_and_keep_the_depth_of_the_centres():
    setup = set_up_capture(VolumetricPerson(dense_human()), poses(), Rig(count=1, width=SIZE, height=SIZE))
    draw = setup.person.posed(setup.skinning[1])
    one, nine = (draw(setup.views[0], samples) for samples in (1, 3))
    np.testing.assert_allclose(nine.depth, one.depth, atol=1e-3)
    inside = nine.alpha > 0.999
    np.testing.assert_allclose(nine.rgb[inside], np.tile(COLOUR, (inside.sum(), 1)), atol=0.01)
    edges = (nine.alpha > 0.05) & (nine.alpha < 0.95)
    np.testing.assert_allclose(nine.rgb[edges], nine.alpha[edges][:, None] * COLOUR, atol=0.02)
    assert edges.sum() > 30
    for samples in (0, 2):
        with refused(ValueError, "samples"):
            draw(setup.views[0], samples)


def test_bands_make_one_picture(monkeypatch):
    setup = set_up_capture(VolumetricPerson(dense_human()), poses(), Rig(count=1, width=SIZE, height=SIZE))
    draw = setup.person.posed(setup.skinning[0])
    at_once = draw(setup.views[0], 1)
    monkeypatch.setattr("primdiffusion.captured_humans.RAYS_AT_ONCE", SIZE * 7)
    in_bands = draw(setup.views[0], 1)
    np.testing.assert_allclose(in_bands.alpha, at_once.alpha, atol=0.05)
    np.testing.assert_allclose(in_bands.depth, at_once.depth, atol=0.002)


def test_everything_visible_is_in_the_pictures(whole):
    subject = open_captures(whole / "captures").subject("ada")
    for frame in range(FRAMES):
        for camera in range(CAMERAS):
            mask = subject.picture("mask", frame, camera)
            assert (mask >= 128).sum() > 500
            assert not mask[0].any()
            assert not mask[-1].any()
            assert not mask[:, 0].any()
            assert not mask[:, -1].any()


def test_captures_of_both_kinds_say_so(whole):
    about = capture_layout.read_about(whole / "captures")
    assert about["passes"] == ["img", "mask", "depth"]
    assert about["renderer"] == "rasteriser and marcher"
    assert open_captures(whole / "captures").subjects == ("ada", "box")
    assert not faults(whole / "captures")
    betas = open_captures(whole / "captures").subject("ada").smpl.betas
    assert betas.tolist() == [1.0, -1.0] + [0.0] * 8


def test_pycocotools_reads_a_generated_humans_masks_and_keypoints(whole):
    coco_tools = pytest.importorskip("pycocotools.coco")
    cli.main(["captures", "coco", str(whole / "captures")])
    try:
        coco = coco_tools.COCO(whole / "captures" / "annotations.json")
    finally:
        (whole / "captures" / "annotations.json").unlink()
    subject = open_captures(whole / "captures").subject("ada")
    with np.load(whole / "captures" / "ada" / "joints.npz") as noted:
        projected = noted["pixel"]
    found = [one for one in coco.loadAnns(coco.getAnnIds()) if one["subject"] == "ada"]
    assert len(found) == FRAMES * CAMERAS
    for annotation in found:
        image = coco.imgs[annotation["image_id"]]
        stored = subject.picture("mask", image["frame"], image["camera"])
        assert np.array_equal(coco.annToMask(annotation), stored >= 128)
        keypoints = np.reshape(annotation["keypoints"], (17, 3))
        assert annotation["num_keypoints"] == 17  # the face's too: the human is on the default body
        joints = projected[image["camera"], image["frame"], [16, 17, 1, 2, 7, 8]]  # shoulders, hips, ankles
        np.testing.assert_allclose(keypoints[[5, 6, 11, 12, 15, 16], :2] + 0.5, joints, atol=0.01)
        inside = stored[tuple((keypoints[:, 1::-1] + 0.5).astype(int).T)] >= 128
        assert inside.sum() >= 15
        assert annotation["smpl"]["betas"] == [1.0, -1.0] + [0.0] * 8


def test_a_generated_human_stands_beside_a_mesh(tmp_path):
    save_person(tmp_path / "people" / "box" / "person.glb")
    save(tmp_path / "people" / "ada" / "person.human.safetensors")
    cli.main(words(tmp_path, "--together", "2"))
    captures = open_captures(tmp_path / "captures")
    ada, box = captures.subject("ada"), captures.subject("box")
    for view, same in zip(ada.views, box.views, strict=True):
        assert np.array_equal(view.translation, same.translation)
    people = [read_subject(tmp_path / "people" / name) for name in ("ada/person.human.safetensors", "box/person.glb")]
    setup = set_up_together(people, 0, poses(), Rig(count=CAMERAS, width=SIZE, height=SIZE), np.random.default_rng(1))
    for matrices in setup.skinning:
        assert setup.person.points(matrices)[:, 1].min() == pytest.approx(0, abs=1e-4)
    cli.main(["captures", "coco", str(tmp_path / "captures")])
    written = json.loads((tmp_path / "captures" / "annotations.json").read_text())
    assert [image["subjects"] for image in written["images"]] == [["ada", "box"]] * (FRAMES * CAMERAS)
    assert {one["subject"] for one in written["annotations"]} == {"ada", "box"}
    with Image.open(tmp_path / "captures" / written["images"][0]["file_name"]) as picture:
        shown = np.asarray(picture).astype(int)
    mask = ada.picture("mask", 0, 0)
    assert np.median(shown[mask == 255][:, 0]) > 200


def test_float_depth_is_written_only_if_asked_for_and_goes_on(whole, tmp_path):
    assert not (whole / "captures" / "ada" / "depth_float").exists()
    line = [*words(whole), "--out", str(tmp_path / "out"), "--passes", "img", "depth", "--float-depth"]
    cli.main(line)
    assert capture_layout.read_about(tmp_path / "out")["passes"] == ["img", "depth", "depth_float"]
    before = everything(tmp_path / "out")
    for name in ("ada", "box"):
        path = capture_layout.picture_path(tmp_path / "out" / name, "depth_float", 1, 0)
        path.unlink()
        (tmp_path / "out" / name / capture_layout.COMPLETE_FILE).unlink()
    cli.main(line)
    after = everything(tmp_path / "out")
    assert {name for name in before if before[name] != after[name]} <= {"report.json"}
    assert not faults(tmp_path / "out")
    assert open_captures(tmp_path / "out").subject("ada").picture("depth", 0, 0).any()


@pytest.mark.parametrize("passes", [["normal"], ["img", "part"]])
def test_passes_that_volumes_do_not_have_are_refused(whole, tmp_path, fails, passes):
    assert "ada" in fails(*words(whole), "--out", tmp_path / "out", "--passes", *passes).err
    assert not (tmp_path / "out").exists()


def test_a_damaged_human_fails_alone(tmp_path, fails):
    save(tmp_path / "people" / "ada.human")
    save(tmp_path / "people" / "empty.human", density=0.0)
    (tmp_path / "people" / "cut.human").write_bytes((tmp_path / "people" / "ada.human").read_bytes()[:5000])
    fails(*words(tmp_path))
    report = json.loads((tmp_path / "captures" / "report.json").read_text())
    assert report["done"] == ["ada"]
    assert {failure["subject"]: failure["what"] for failure in report["failed"]} == {"cut": "render", "empty": "render"}
    assert open_captures(tmp_path / "captures").subjects == ("ada",)


def test_humans_are_found_by_their_names(tmp_path):
    for name in ("a.human", "b.human.safetensors", "c/person.human.safetensors", "d e.human"):
        save(tmp_path / name)
    save_person(tmp_path / "f" / "person.glb")
    assert list(find_subjects(tmp_path)) == ["a", "b", "c", "f"]
    assert find_subjects(tmp_path / "a.human") == {"a": tmp_path / "a.human"}
    assert renderer_name([tmp_path / "f" / "person.glb"]) == "rasteriser"
    assert renderer_name([tmp_path / "a.human"]) == "marcher"
    for one in ("d e.human", "f/person.glb"):
        with refused(ValueError, one):
            find_subjects(tmp_path / one)
    with refused(FileNotFoundError, "nowhere"):
        find_subjects(tmp_path / "nowhere")
    save_person(tmp_path / "a" / "person.glb")
    with refused(ValueError, "a.human"):
        find_subjects(tmp_path)
