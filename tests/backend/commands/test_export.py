"""`primdiffusion export` and the child's jobs proxy, gaussians and merge: files, axes, errors."""

import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import splatter
import torch
import trimesh
from export_people import person
from primdiffusion import cli
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.commands.export import gaussians, merge, proxy
from primdiffusion.commands.session import Session
from primdiffusion.editing.reshaping import reshape_human
from primdiffusion.export.merged_file import upright_grid
from primdiffusion.formats.requests import GaussiansRequest, MergeRequest, PosedPerson, ProxyRequest
from primdiffusion.human import place, pose_body
from primdiffusion.human_file import save_human
from primdiffusion.render.merge import merge as merge_boxes
from primdiffusion.runtime.failures import MissingPackageError
from support.errors import refused

COARSE = ["--triangles", "800", "--texture", "64", "--spacing", "0.03"]


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "anna.human"
    save_human(path, person())
    return path


def silent(*_args, **_named):
    pass


def test_a_person_becomes_a_glb(saved, capsys):
    out = saved.with_name("anna.glb")
    cli.run(["export", str(saved), "--out", str(out), *COARSE])
    assert capsys.readouterr().out.strip() == str(out)
    assert len(trimesh.load(out).geometry["person"].faces) <= 800


def test_a_posed_person_becomes_gaussians(saved):
    pose = saved.with_name("pose.json")
    pose.write_text(str([0.0] * 49 + [-1.2] + [0.0] * 22))
    bent = saved.with_name("b.ply")
    cli.run(["export", str(saved), "--out", str(bent), "--gaussians", "3000", "--pose", str(pose)])
    ply = splatter.read_ply(bent)
    assert float(place(person()).position[:, 0].max()) > ply["x"].max() + 0.05
    assert ply["y"].min() == pytest.approx(0, abs=0.05), "the soles are on the floor"


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (["--out", "anna.stl"], "out is 'anna.stl': give"),
        (["--out", "anna.glb", "--pose", "pose.json"], "pose cannot be stored"),
        (["--out", "anna.ply", "--frame", "2"], "frame is 2"),
        (["--out", "nowhere/anna.glb"], "there is no folder"),
        (["--out", "anna.npz", "--voxel", "0"], "voxel is 0"),
        (["--out", "anna.npz", "--voxel", "0.0001"], "mm or more"),
    ],
)
def test_what_cannot_be_exported_is_rejected_before_any_work(saved, monkeypatch, more, sentence):
    monkeypatch.chdir(saved.parent)
    with refused((ValueError, FileNotFoundError), sentence):
        cli.run(["export", str(saved), *more])
    assert list(saved.parent.iterdir()) == [saved]


def test_the_childs_proxy_follows_other_betas(saved, tmp_path):
    betas = [3.0] + [0.0] * 9
    asked = ProxyRequest(
        person=saved, out_dir=tmp_path / "tall", betas=betas, triangles=800, texture_px=64, spacing=0.03
    )
    result = proxy(asked, Session(), silent)
    own, tall = (np.ptp(default_body().shape(one).vertices[:, 1]) for one in (person().betas, torch.tensor(betas)))
    with np.load(result.proxy) as arrays:
        height = np.ptp(arrays["vertices"][:, 1])
        assert arrays["joint_names"][0] == "pelvis"
    assert abs(height - tall) < abs(height - own)
    assert abs(tall - own) > 0.1


def test_the_childs_gaussians_stand_where_the_armature_does(saved, tmp_path):
    skinning = pose_body(person().betas).skinning[:, :3].tolist()
    moved = [[1.0, 0, 0, 2.0], [0, 1.0, 0, 0], [0, 0, 1.0, 0]]
    request = GaussiansRequest(person=PosedPerson(saved, moved, skinning), out=tmp_path / "p.ply", limit=2000)
    assert gaussians(request, Session(), silent).gaussians == 2000
    assert splatter.read_ply(tmp_path / "p.ply")["x"].mean() == pytest.approx(2.0, abs=0.1)


def test_a_cancelled_proxy_leaves_nothing(saved, tmp_path):
    def cancel(stage, *_):
        if stage == "write":
            raise InterruptedError

    request = ProxyRequest(person=saved, out_dir=tmp_path / "new", triangles=800, texture_px=64, spacing=0.03)
    with pytest.raises(InterruptedError):
        proxy(request, Session(), cancel)
    assert not (tmp_path / "new").exists()


def test_betas_of_another_body_are_rejected(saved, tmp_path):
    request = ProxyRequest(person=saved, out_dir=tmp_path / "out", betas=[0.0] * 3)
    with refused(ValueError, "3 betas"):
        proxy(request, Session(), silent)


VOXEL = 0.03
STILL = torch.eye(3, 4).tolist()


def pose(seed: int) -> BodyPose:
    return BodyPose.from_axis_angle(0.3 * torch.randn(72, generator=torch.Generator().manual_seed(seed)))


@pytest.fixture
def posed(human, tmp_path) -> PosedPerson:
    save_human(tmp_path / "a.human.safetensors", human)
    joints = pose_body(human.betas, pose(2)).skinning[:, :3].tolist()
    return PosedPerson((tmp_path / "a.human.safetensors"), STILL, joints)


def done(out_dir: Path, *people: PosedPerson, report=silent) -> list[Path]:
    return merge(MergeRequest(people=list(people), out_dir=out_dir, voxel=VOXEL), Session(), report).files


def test_a_grid_is_the_posed_person_turned_z_up(human, posed, tmp_path):
    (file,) = done(tmp_path / "grids", posed)
    with np.load(file, allow_pickle=False) as grid:
        density, colour, origin = grid["density"], grid["colour"], grid["origin"]
        assert density.dtype == colour.dtype == np.float16
        assert grid["voxel"] == VOXEL
    expected = merge_boxes(place(human, pose(2)), VOXEL)

    def centre(values: np.ndarray, start: np.ndarray) -> np.ndarray:
        where = np.stack(np.meshgrid(*map(np.arange, values.shape), indexing="ij"), -1)
        return start + VOXEL * np.average(where.reshape(-1, 3), axis=0, weights=values.ravel().astype(np.float64))

    x, y, z = centre(expected.density, expected.origin)
    np.testing.assert_allclose(centre(density, origin), [x, -z, y], atol=2e-3)
    assert density.astype(np.float64).sum() == pytest.approx(expected.density.sum(dtype=np.float64), rel=0.02)


def test_other_betas_merge_the_reshaped_person_whose_boxes_have_grown(human, posed, tmp_path):
    betas = human.betas + torch.tensor([0.0, 3.0, 1.0, 2.0, 0.0, 4.0, 0.0, 0.0, 0.0, 0.0])
    joints = pose_body(betas, pose(2)).skinning[:, :3].tolist()
    wider = dataclasses.replace(posed, joints=joints, betas=betas.tolist())
    (file,) = done(tmp_path / "grids", wider)
    with np.load(file, allow_pickle=False) as grid:
        got = grid["density"].sum(dtype=np.float64)
    grown, ungrown = (
        upright_grid(place(one, pose(2)), VOXEL).density.sum(dtype=np.float64)
        for one in (reshape_human(human, betas), dataclasses.replace(human, betas=betas))
    )
    assert abs(grown / ungrown - 1) > 0.02
    assert got == pytest.approx(grown, rel=1e-3)


def test_frames_are_the_person_s_single_grids(human, posed, tmp_path):
    other = dataclasses.replace(posed, joints=pose_body(human.betas, pose(5)).skinning[:, :3].tolist())
    reports = []
    files = done(tmp_path / "new" / "grids", posed, other, report=lambda *report: reports.append(report))
    assert [report[:3] for report in reports] == [("merge", 0, 2), ("merge", 1, 2), ("merge", 2, 2)]
    (alone,) = done(tmp_path / "alone", other)
    for name, values in grid_of(alone).items():
        np.testing.assert_array_equal(grid_of(files[1])[name], values)
    assert grid_of(files[0])["density"].shape != grid_of(alone)["density"].shape


@pytest.fixture
def blenders_openvdb(monkeypatch):
    """The module that Blender brings along."""
    spec = importlib.util.find_spec("bpy")
    if spec is None or spec.origin is None:
        pytest.skip("bpy is not installed")
    (folder,) = Path(spec.origin).parent.glob("*/python/lib/python3.*/site-packages")
    monkeypatch.syspath_prepend(str(folder))
    return pytest.importorskip("openvdb")


def grid_of(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as arrays:
        return dict(arrays)


def test_a_vdb_holds_the_same_numbers_where_they_belong(saved, tmp_path, blenders_openvdb):
    cli.run(["export", str(saved), "--out", str(tmp_path / "anna.npz"), "--voxel", "0.03"])
    cli.run(["export", str(saved), "--out", str(tmp_path / "anna.vdb"), "--voxel", "0.03"])
    grid = grid_of(tmp_path / "anna.npz")
    stored = {one.name: one for one in blenders_openvdb.readAllGridMetadata(str(tmp_path / "anna.vdb"))}
    assert set(stored) == {"density", "Cd"}
    density = blenders_openvdb.read(str(tmp_path / "anna.vdb"), "density")
    values = np.zeros(grid["density"].shape, np.float32)
    density.copyToArray(values)
    np.testing.assert_array_equal(values, grid["density"].astype(np.float32))
    np.testing.assert_allclose(density.transform.indexToWorld((0, 0, 0)), grid["origin"], atol=1e-6)
    assert density.transform.voxelSize()[0] == pytest.approx(0.03)


def test_without_openvdb_a_vdb_is_rejected_before_any_work(saved, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "openvdb", None)
    with refused(MissingPackageError, ".npz"):
        cli.run(["export", str(saved), "--out", str(tmp_path / "anna.vdb")])
    assert list(tmp_path.iterdir()) == [saved]
