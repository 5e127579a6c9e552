"""The file format both programs write, and the cameras of a camera_rig."""

import json
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from primdiffusion.files import picture_files
from primdiffusion.files.regular_files import FileError
from primdiffusion.formats import camera_rig, capture_layout
from primdiffusion.geometry.camera import look_at
from support.errors import refused

ROOT = Path(__file__).resolve().parents[2]
BACKEND = ROOT / "backend" / "primdiffusion"
SMALL = camera_rig.Rig(count=7, width=40, height=60)


def test_the_extension_imports_the_backends_formats_and_nothing_else_of_it():
    torch_alone = {"files.folder_lock", "files.tensor_file", "files.torch_file"}
    paths = [path for room in ("files", "formats") for path in (BACKEND / room).glob("[a-z]*.py")]
    names = sorted({f"{path.parent.name}.{path.stem}" for path in paths} - torch_alone)
    program = f"""
import importlib, sys
sys.modules["torch"] = sys.modules["primdiffusion"] = None  # importing them fails
for name in {names}:
    module = importlib.import_module(f"blender_primdiffusion.{{name}}")
    print(name, module.__file__)
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    files = dict(line.split(maxsplit=1) for line in done.stdout.splitlines())
    assert files == {name: str(BACKEND / f"{name.replace('.', '/')}.py") for name in names}
    assert {"files.arrays", "formats.capture_layout"} <= files.keys()


@pytest.mark.parametrize("arrangement", ["rings", "sphere", "hemisphere"])
def test_every_camera_sees_the_whole_sphere_and_has_its_centre_in_the_middle(arrangement):
    target, radius = np.array([0.1, 0.9, -0.2]), 1.1
    generator = np.random.default_rng(0)
    points = generator.standard_normal((500, 3))
    points = target + radius * points / np.linalg.norm(points, axis=1, keepdims=True)
    views = camera_rig.Rig(arrangement, 36, width=300, height=500).views(target, radius)
    assert len(views) == 36
    for view in views:
        middle, depth = view.project(target)
        assert np.allclose(middle, (150, 250))
        assert depth > radius
        assert np.allclose(view.rotation @ view.rotation.T, np.eye(3))
        assert np.linalg.det(view.rotation) > 0
        pixels, _ = view.project(points)
        assert (pixels > 0).all()
        assert (pixels < (300, 500)).all()


def test_a_camera_is_the_backends_camera():
    position, target = np.array([1.0, 2.0, 3.0]), np.array([0.2, 0.9, 0.1])
    ours = camera_rig.look_at(position, target, 0.6, 320, 200)
    theirs = look_at(torch.tensor(position), torch.tensor(target), vertical_fov=0.6, width=320, height=200)
    assert np.allclose(ours.intrinsics, theirs.intrinsics)
    assert np.allclose(np.c_[ours.rotation, ours.translation], theirs.world_to_camera)


def test_a_camera_straight_above_is_possible():
    view = camera_rig.look_at(np.array([0.0, 5.0, 0.0]), np.zeros(3), 0.6, 10, 10)
    assert np.isfinite(view.rotation).all()
    assert np.allclose(view.project(np.zeros(3))[0], 5)


@pytest.mark.parametrize("wrong", [{"count": 0}, {"vertical_fov": 0.0}, {"width": 0}, {"elevations": (90.0,)}])
def test_impossible_rigs_are_rejected(wrong):
    with refused(ValueError, next(iter(wrong))):
        camera_rig.Rig(**wrong)


def test_pngs_are_what_another_reader_reads(tmp_path):
    generator = np.random.default_rng(0)
    for dtype, shape in ((np.uint8, (7, 5)), (np.uint8, (7, 5, 3)), (np.uint8, (7, 5, 4)), (np.uint16, (7, 5))):
        pixels = generator.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
        picture_files.write_png(tmp_path / "a.png", pixels)
        assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png")), pixels)
        assert picture_files.is_whole_picture(tmp_path / "a.png")


@pytest.mark.parametrize("cut", [0, 4, 40, 250, 330, -1])
def test_an_exr_that_is_cut_short_or_changed_is_not_whole(tmp_path, cut):
    path = tmp_path / "a.exr"
    picture_files.write_exr(path, np.ones((37, 53)))
    content = path.read_bytes()
    path.write_bytes(content[:cut])
    assert not picture_files.is_whole_picture(path)
    path.write_bytes(content + b"\0")
    assert not picture_files.is_whole_picture(path)
    window = content.index(b"box2i") + 10
    for numbers in ((0, 0, 2**31 - 1, 2**31 - 1), (0, 0, -9, -9), (0, 0, 52, 2**31 - 1)):
        path.write_bytes(content[:window] + struct.pack("<4i", *numbers) + content[window + 16 :])
        assert not picture_files.is_whole_picture(path)


def test_smpl_parameters_are_read_plain_and_as_the_released_code_does(tmp_path):
    generator = np.random.default_rng(0)
    capture_layout.write_smpl(tmp_path, *(generator.random(shape) for shape in ((4, 3), (4, 69), (10,), (4, 3))))
    plain = np.load(tmp_path / capture_layout.SMPL_FOLDER / capture_layout.SMPL_PLAIN_FILE, allow_pickle=False)
    pickled = np.load(tmp_path / capture_layout.SMPL_FOLDER / capture_layout.SMPL_FILE, allow_pickle=True)[
        "smpl"
    ].item()
    assert set(plain.files) == set(pickled) == {"global_orient", "body_pose", "betas", "transl"}
    assert all(np.array_equal(plain[name], pickled[name]) for name in pickled)


def test_a_folder_is_claimed_once(tmp_path):
    capture_layout.claim(tmp_path / "a", {"seed": 1, "size": (3, 4)})
    capture_layout.claim(tmp_path / "a", {"seed": 1, "size": (3, 4)})
    with refused(FileError, "seed is 1", "not 2"):
        capture_layout.claim(tmp_path / "a", {"seed": 2, "size": (3, 4)})
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "thesis.tex").touch()
    with refused(FileError):
        capture_layout.claim(tmp_path / "b", {"seed": 1})


def test_damage_is_found(tmp_path):
    views = SMALL.views(np.zeros(3), 1.0)
    capture_layout.write_cameras(tmp_path, views)
    capture_layout.write_joints(tmp_path, views, np.zeros((2, 24, 3)))
    for camera in range(3):
        picture_files.write_png(capture_layout.picture_path(tmp_path, "mask", camera, 0), np.zeros((60, 40), np.uint8))
    assert capture_layout.damage(tmp_path) == {tmp_path: "not finished"}
    capture_layout.complete(tmp_path)
    assert capture_layout.damage(tmp_path) == {}
    paths = [capture_layout.picture_path(tmp_path, "mask", camera, 0) for camera in range(3)]
    paths[0].unlink()
    paths[1].write_bytes(paths[1].read_bytes()[:-5])
    changed = bytearray(paths[2].read_bytes())
    changed[40] ^= 1
    paths[2].write_bytes(changed)
    assert list(capture_layout.damage(tmp_path).values()) == [
        "missing",
        f"{paths[1].stat().st_size} bytes instead of {paths[1].stat().st_size + 5}",
        "altered",
    ]
    assert len(capture_layout.damage(tmp_path, checksums=False)) == 2
    assert not picture_files.is_whole_picture(paths[1])


def test_nothing_is_left_of_a_file_that_failed(tmp_path):
    with refused(ValueError, "uint8"):
        picture_files.write_png(tmp_path / "a.png", np.zeros((2, 2)))
    assert list(tmp_path.iterdir()) == []


def test_depth_far_or_absent_is_nothing():
    assert picture_files.depth_steps(np.array([np.inf, 0.5, 20.0, np.nan])).tolist() == [0, 2000, 0, 0]


def test_pictures_have_noise_of_their_own():
    seeds = {capture_layout.view_seed(0, f"p{p}", f, c) for p in range(5) for f in range(5) for c in range(5)}
    assert len(seeds) == 125
    assert all(0 <= seed < 2**31 for seed in seeds)


def test_a_completion_mark_cannot_name_files_elsewhere(tmp_path):
    subject = tmp_path / "one"
    subject.mkdir()
    (tmp_path / "thesis.tex").write_text("mine")
    for name in ("../thesis.tex", str(tmp_path / "thesis.tex"), "a/../../thesis.tex"):
        (subject / capture_layout.COMPLETE_FILE).write_text(json.dumps({name: [1, 1]}))
        assert capture_layout.damage(subject) == {subject: "not finished"}
