"""`primdiffusion merge`: people as one volume in a file."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from primdiffusion import cli
from primdiffusion.human import generate
from primdiffusion.human_file import save_human
from primdiffusion.runtime.failures import MissingPackageError
from tiny_model import tiny_model

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


def test_several_stand_side_by_side(saved, tmp_path):
    cli.run(["merge", str(saved), str(saved), "--apart", "3", "--out", str(tmp_path / "two.npz"), *COARSE])
    cli.run(["merge", str(saved), "--out", str(tmp_path / "one.npz"), *COARSE])
    one, two = (grid_of(tmp_path / f"{name}.npz") for name in ("one", "two"))
    assert (two["density"].shape[0] - one["density"].shape[0]) * 0.03 == pytest.approx(3, abs=0.07)
    assert two["origin"][2] == pytest.approx(0, abs=0.2), "the soles are on the floor"
    middles = [float(grid["origin"][0] + 0.03 * (grid["density"].shape[0] - 1) / 2) for grid in (one, two)]
    assert middles[1] == pytest.approx(middles[0], abs=0.07), "around the place of one"
    masses = [grid["density"].sum(dtype=np.float64) for grid in (one, two)]
    assert masses[1] == pytest.approx(2 * masses[0], rel=0.02)


def test_a_vdb_holds_the_same_numbers_where_they_belong(saved, tmp_path, blenders_openvdb):
    cli.run(["merge", str(saved), "--out", str(tmp_path / "anna.npz"), *COARSE])
    cli.run(["merge", str(saved), "--out", str(tmp_path / "anna.vdb"), *COARSE])
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
        cli.run(["merge", str(saved), "--out", str(tmp_path / "anna.vdb")])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (["--out", "anna.obj"], r"^out is .*\.vdb or \.npz"),
        (["--out", "nowhere/anna.npz"], "there is no folder"),
        (["--out", "anna.npz", "--voxel", "0"], "^voxel is 0"),
        (["--out", "anna.npz", "--voxel", "0.0001"], "choose .* mm or more"),
        (["--out", "anna.npz", "--frame", "2"], "^frame is 2"),
        (["--out", "anna.npz", "--apart", "inf"], "apart is inf"),
    ],
)
def test_what_cannot_be_merged_is_rejected_and_leaves_nothing(saved, tmp_path, monkeypatch, more, sentence):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ValueError, FileNotFoundError), match=sentence):
        cli.run(["merge", str(saved), *more])
    assert not list(tmp_path.iterdir())
