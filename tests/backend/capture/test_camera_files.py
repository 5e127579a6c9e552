"""Camera files that `captures export` writes from finished captures."""

import json
import shutil

import numpy as np
import pytest
from capture_scenes import captured
from primdiffusion.capture.camera_files import export_cameras
from primdiffusion.capture.reader import open_captures
from primdiffusion.cli import run
from primdiffusion.files.regular_files import FileError
from primdiffusion.formats.capture_repair import verify
from scipy.spatial.transform import Rotation
from support.errors import refused


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    root = captured(tmp_path_factory.mktemp("captures"), people=2, frames=2, passes=("img", "mask"))
    run(["captures", "export", str(root)])
    return root


def test_colmaps_quaternions_nerfs_matrices_and_opencvs_arrays_are_the_same_cameras(exported):
    captures = open_captures(exported)
    for name in captures.subjects:
        subject, views = exported / name, captures.subject(name).views
        lines = (subject / "colmap/0001/images.txt").read_text().splitlines()[1::2]
        frames = json.loads((subject / "nerf/0001/transforms.json").read_text())["frames"]
        arrays = np.load(subject / "opencv/cameras.npz")
        for i, (view, line, frame) in enumerate(zip(views, lines, frames, strict=True)):
            _, w, x, y, z, *translation, _, picture = line.split()
            rotation = Rotation.from_quat([float(value) for value in (x, y, z, w)]).as_matrix()
            assert float(w) >= 0
            assert np.allclose(rotation, view.rotation, atol=1e-12)
            assert np.allclose(np.array(translation, float), view.translation)
            assert picture == f"camera{i:04d}/0001.jpg"
            assert (subject / "img" / picture).is_file()
            assert (subject / "nerf/0001" / frame["file_path"]).resolve() == (subject / "img" / picture).resolve()
            to_world = np.array(frame["transform_matrix"])
            in_opengl = np.linalg.inv(to_world) @ [0.3, 0.2, 0.1, 1]
            assert np.allclose(in_opengl[:3] * (1, -1, -1), view.rotation @ [0.3, 0.2, 0.1] + view.translation)
            assert np.array_equal(arrays["K"][i] @ np.c_[arrays["R"][i], arrays["T"][i]], _projection(view))


def _projection(view):
    return view.intrinsics @ np.c_[view.rotation, view.translation]


def test_an_export_leaves_captures_whole_and_a_second_one_leaves_them_as_they_are(exported):
    assert verify(exported) == {}
    before = {path: path.stat().st_mtime_ns for path in exported.rglob("*")}
    run(["captures", "export", str(exported), "--projects", "colmap"])
    assert {path: path.stat().st_mtime_ns for path in exported.rglob("*")} == before


def test_captures_without_colour_and_links_out_of_them_are_refused(exported, tmp_path):
    captures = open_captures(exported)
    captures.about["passes"].remove("img")  # pyright: ignore
    with refused(ValueError, str(exported), "pass img"):
        list(export_cameras(captures, ("nerf",)))
    root, outside = tmp_path / "captures", tmp_path / "outside"
    shutil.copytree(exported, root)
    outside.mkdir()
    shutil.rmtree(root / captures.subjects[0] / "nerf")
    (root / captures.subjects[0] / "nerf").symlink_to(outside)
    with refused(FileError, "nerf"):
        list(export_cameras(open_captures(root), ("nerf",)))
    assert not list(outside.iterdir())
