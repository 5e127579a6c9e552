"""VDB files: their content, where it lies, and that a failed write leaves nothing."""

from pathlib import Path

import bpy
import numpy as np
import pytest
import synthetic

from blender_primdiffusion.scene import volumes
from blender_primdiffusion.scene.volume_nodes import FILES
from blender_primdiffusion.scene.volumes import FAINTEST, bake, window, write_volume

pytestmark = pytest.mark.any_blender

bpy.utils.expose_bundled_modules()
import openvdb  # noqa: E402


def written(grids, folder) -> list[Path]:
    folder.mkdir()
    paths = [folder / FILES.format(k) for k in range(len(grids.density))]
    for k, path in enumerate(paths):
        write_volume(grids, k, path)
    return paths


@pytest.fixture
def human() -> dict:
    return synthetic.arrays(6)


@pytest.fixture
def grids(human):
    return bake(human["density"], human["rgb"], human["half_extent"])


def test_the_window_is_the_marchers():
    y = [-1 + 2 * i / 7 for i in range(8)]
    assert window()[1, 2, 6] == pytest.approx(np.exp(-8 * (y[1] ** 8 + y[2] ** 8 + y[6] ** 8)), rel=1e-12)
    assert window().max() > 0.999


def test_files_hold_the_windowed_payload_at_half_precision_with_x_along_t(human, grids, tmp_path):
    files = written(grids, tmp_path / "h")
    for k, path in enumerate(files):
        read, _ = openvdb.readAll(str(path))
        density, colour = sorted(read, key=lambda grid: grid.name, reverse=True)
        assert (density.name, colour.name) == ("density", "Cd")
        assert density.gridClass == openvdb.GridClass.FOG_VOLUME
        values, colours = np.zeros((12, 12, 12), np.float32), np.zeros((12, 12, 12, 3), np.float32)
        density.copyToArray(values, ijk=(-2, -2, -2))
        colour.copyToArray(colours, ijk=(-2, -2, -2))
        expected = (human["density"][k] * window()).transpose(2, 1, 0)  # D, H, W along N, B, T -> x, y, z along T, B, N
        expected[expected < FAINTEST] = 0
        inside = values[2:10, 2:10, 2:10]
        np.testing.assert_allclose(inside, expected, rtol=1e-3)
        assert values.sum() == inside.sum()
        full = expected > 0
        assert full.sum() > 100
        np.testing.assert_allclose(
            colours[2:10, 2:10, 2:10][full], human["rgb"][k].transpose(2, 1, 0, 3)[full], rtol=1e-3, atol=1e-4
        )


def test_one_empty_voxel_surrounds_the_dense_ones_and_no_more_is_stored(human, tmp_path):
    density = np.zeros((3, 8, 8, 8), np.float32)
    density[0, 3:5, 2, 1:6] = 50  # D, H, W
    density[1] = 1e4  # the window ends before the rim at any density
    grids = bake(density, human["rgb"][:3], human["half_extent"][:3])
    files = written(grids, tmp_path / "h")
    boxes = [openvdb.read(str(path), "density").evalActiveVoxelBoundingBox() for path in files]
    assert boxes[0] == ((0, 1, 2), (6, 3, 5))
    assert boxes[1] == ((0, 0, 0), (7, 7, 7))
    assert boxes[2] == ((3, 3, 3), (3, 3, 3))  # an empty primitive


def test_voxels_lie_corner_aligned_in_the_box(human, grids, tmp_path):
    files = written(grids, tmp_path / "h")
    for k, path in enumerate(files):
        transform = openvdb.read(str(path), "density").transform
        half = human["half_extent"][k]
        np.testing.assert_allclose(transform.indexToWorld((0, 0, 0)), -half, atol=1e-7)
        np.testing.assert_allclose(transform.indexToWorld((7, 7, 7)), half, atol=1e-7)


def test_density_beyond_half_precision_is_clamped_not_infinite(human):
    baked = bake(human["density"] * 1e6, human["rgb"], human["half_extent"])
    assert np.isfinite(baked.density).all()


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), RuntimeError("disk full")])
def test_a_volume_appears_whole_or_not_at_all(grids, tmp_path, monkeypatch, error):
    (path, *_), before = written(grids, tmp_path / "h"), sorted((tmp_path / "h").iterdir())
    content = path.read_bytes()

    def half(path, *_):
        path.write_bytes(content[:100])
        raise error

    monkeypatch.setattr(volumes, "write_vdb", half)
    with pytest.raises(type(error)):
        write_volume(grids, 0, path)
    assert path.read_bytes() == content
    assert sorted(path.parent.iterdir()) == before
