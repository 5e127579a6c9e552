"""The child's jobs for other renderers, without the child: files, axes, errors."""

import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from primdiffusion import cli
from primdiffusion.body.model import BodyPose
from primdiffusion.commands import export as commands
from primdiffusion.commands.session import Session
from primdiffusion.editing.reshaping import reshaped
from primdiffusion.export.merged_file import upright_grid
from primdiffusion.formats.requests import MergeRequest, PosedPerson
from primdiffusion.human import generate, place, pose_body
from primdiffusion.human_file import save_human
from primdiffusion.render.merge import merge
from primdiffusion.runtime.failures import MissingPackageError
from support.tiny import tiny_model

VOXEL = 0.03
STILL = torch.eye(3, 4).tolist()


def pose(seed: int) -> BodyPose:
    return BodyPose.from_axis_angle(0.3 * torch.randn(72, generator=torch.Generator().manual_seed(seed)))


@pytest.fixture(scope="module")
def human():
    return generate(tiny_model(), seed=3, steps=5)


@pytest.fixture
def person(human, tmp_path) -> PosedPerson:
    save_human(tmp_path / "a.human.safetensors", human)
    joints = pose_body(human.betas, pose(2)).skinning[:, :3].tolist()
    return PosedPerson((tmp_path / "a.human.safetensors"), STILL, joints)


def quiet(*_: object, **__: object) -> None:
    """Hears no report."""


def done(out_dir: Path, *people: PosedPerson, report=quiet) -> list[Path]:
    return commands.merge(MergeRequest(people=list(people), out_dir=out_dir, voxel=VOXEL), Session(), report).files


def test_a_grid_is_the_posed_person_turned_z_up(human, person, tmp_path):
    (file,) = done(tmp_path / "grids", person)
    with np.load(file, allow_pickle=False) as grid:
        density, colour, origin = grid["density"], grid["colour"], grid["origin"]
        assert density.dtype == colour.dtype == np.float16
        assert grid["voxel"] == VOXEL
    expected = merge(place(human, pose(2)), VOXEL)

    def centre(values: np.ndarray, start: np.ndarray) -> np.ndarray:
        where = np.stack(np.meshgrid(*map(np.arange, values.shape), indexing="ij"), -1)
        return start + VOXEL * np.average(where.reshape(-1, 3), axis=0, weights=values.ravel().astype(np.float64))

    x, y, z = centre(expected.density, expected.origin)
    np.testing.assert_allclose(centre(density, origin), [x, -z, y], atol=2e-3)
    assert density.astype(np.float64).sum() == pytest.approx(expected.density.sum(dtype=np.float64), rel=0.02)


def test_other_betas_merge_the_reshaped_person_whose_boxes_have_grown(human, person, tmp_path):
    betas = human.betas + torch.tensor([0.0, 3.0, 1.0, 2.0, 0.0, 4.0, 0.0, 0.0, 0.0, 0.0])
    joints = pose_body(betas, pose(2)).skinning[:, :3].tolist()
    wider = dataclasses.replace(person, joints=joints, betas=betas.tolist())
    (file,) = done(tmp_path / "grids", wider)
    with np.load(file, allow_pickle=False) as grid:
        got = grid["density"].sum(dtype=np.float64)
    grown, ungrown = (
        upright_grid(place(one, pose(2)), VOXEL).density.sum(dtype=np.float64)
        for one in (reshaped(human, betas), dataclasses.replace(human, betas=betas))
    )
    assert abs(grown / ungrown - 1) > 0.02
    assert got == pytest.approx(grown, rel=1e-3)


def test_frames_are_the_person_s_single_grids(human, person, tmp_path):
    other = dataclasses.replace(person, joints=pose_body(human.betas, pose(5)).skinning[:, :3].tolist())
    reports = []
    files = done(tmp_path / "new" / "grids", person, other, report=lambda *report: reports.append(report))
    assert [report[:3] for report in reports] == [("merge", 0, 2), ("merge", 1, 2), ("merge", 2, 2)]
    (alone,) = done(tmp_path / "alone", other)
    for name, values in grid_of(alone).items():
        np.testing.assert_array_equal(grid_of(files[1])[name], values)
    assert grid_of(files[0])["density"].shape != grid_of(alone)["density"].shape


COARSE = ["--voxel", "0.03"]


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("people") / "anna.human"
    save_human(path, generate(tiny_model(), seed=3, steps=5))
    return path


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
    cli.run(["export", str(saved), "--out", str(tmp_path / "anna.npz"), *COARSE])
    cli.run(["export", str(saved), "--out", str(tmp_path / "anna.vdb"), *COARSE])
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
    with pytest.raises(MissingPackageError, match=r"or write an \.npz"):
        cli.run(["export", str(saved), "--out", str(tmp_path / "anna.vdb")])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (["--out", "nowhere/anna.npz"], "there is no folder"),
        (["--out", "anna.npz", "--voxel", "0"], "^voxel is 0"),
        (["--out", "anna.npz", "--voxel", "0.0001"], "choose .* mm or more"),
    ],
)
def test_grids_that_cannot_be_are_rejected_and_leaves_nothing(saved, tmp_path, monkeypatch, more, sentence):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ValueError, FileNotFoundError), match=sentence):
        cli.run(["export", str(saved), *more])
    assert not list(tmp_path.iterdir())
