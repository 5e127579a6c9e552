"""The file format both programs write, and the cameras of a camera_rig."""

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
    torch_alone = {"files.tensor_file", "files.torch_file"}
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


def test_the_list_names_finished_subjects(tmp_path):
    for name in ("one", "two", "three", capture_layout.RELEASED_REFERENCE):
        capture_layout.write_cameras(tmp_path / name, SMALL.views(np.zeros(3), 1.0))
    for name in ("three", "one", capture_layout.RELEASED_REFERENCE):
        capture_layout.complete(tmp_path / name)
    capture_layout.list_subjects(tmp_path)
    assert capture_layout.read_list(tmp_path) == ["one", "three"]
    assert not capture_layout.is_complete(tmp_path / "two")


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
