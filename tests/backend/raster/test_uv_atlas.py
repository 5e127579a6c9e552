"""The UV square as a raster of surface points."""

import dataclasses

import numpy as np
from capture_scenes import box
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.raster.textures import gather_textures
from primdiffusion.raster.uv_atlas import closest_in_uv, rasterise_uv
from support.errors import refused

UV = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
SQUARE = np.array([[0, 1, 2], [0, 2, 3]])


def test_a_texel_shows_the_point_at_its_centre_with_row_zero_at_v_zero():
    raster = rasterise_uv(UV[SQUARE], 4, 8)
    assert raster.covered.all()
    shown = (UV[SQUARE][raster.face] * raster.barycentric[..., None]).sum(2)
    row, column = np.mgrid[:4, :8]
    np.testing.assert_allclose(shown, np.stack([(column + 0.5) / 8, (row + 0.5) / 4], -1), atol=1e-12)


def test_texels_whose_centre_no_face_covers_are_marked():
    triangle = np.array([[[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]]])
    raster = rasterise_uv(triangle, 8, 8)
    row, column = np.mgrid[:8, :8]
    np.testing.assert_array_equal(raster.covered, (row + column + 1) / 8 <= 0.5)
    assert (raster.face[~raster.covered] == -1).all()


def test_the_later_of_overlapping_faces_wins():
    raster = rasterise_uv(np.concatenate([UV[SQUARE], UV[SQUARE[:1]]]), 16, 16)
    assert set(np.unique(raster.face)) == {1, 2}


def test_faces_without_area_and_outside_the_square_draw_nothing():
    line = np.array([[[0.1, 0.1], [0.5, 0.5], [0.9, 0.9]], [[1.5, 0.0], [2.5, 0.0], [1.5, 1.0]]])
    assert not rasterise_uv(line, 32, 32).covered.any()


def test_coordinates_that_are_not_finite_are_rejected():
    with refused(ValueError, "UV map"):
        rasterise_uv(np.full((1, 3, 2), np.nan), 4, 4)


def test_every_takes_each_cells_sample():
    raster = rasterise_uv(UV[SQUARE], 256, 256)
    cells = raster.every(8, 4)
    assert cells.face.shape == (32, 32)
    assert cells.face[3, 5] == raster.face[28, 44]
    np.testing.assert_array_equal(cells.barycentric[3, 5], raster.barycentric[28, 44])


def test_the_closest_chart_point_is_no_farther_than_any_sampled_one():
    generator = np.random.default_rng(0)
    uv = 0.3 + 0.2 * UV
    points = generator.random((50, 2))
    points = points[((points < 0.3) | (points > 0.5)).any(1)]
    face, barycentric = closest_in_uv(uv[SQUARE], SQUARE, points)
    found = (uv[SQUARE][face] * barycentric[..., None]).sum(1)
    brute = np.linalg.norm(points - np.clip(points, 0.3, 0.5), axis=1)
    np.testing.assert_allclose(np.linalg.norm(points - found, axis=1), brute, atol=1e-12)
    np.testing.assert_allclose(barycentric.sum(1), 1)


def test_a_closed_uv_map_has_no_outline_to_be_closest_to():
    with refused(ValueError, "boundary"):
        closest_in_uv(UV[np.array([[0, 1, 2], [0, 2, 1]])], np.array([[0, 1, 2], [0, 2, 1]]), np.array([[2.0, 2.0]]))


def test_a_texture_that_parts_share_is_held_once_and_read_as_before():
    texture = np.random.default_rng(0).integers(0, 256, (13, 8, 4), dtype=np.uint8)
    parts = [dataclasses.replace(box(name), texture=texture) for name in "ab"]
    parts.insert(1, box("plain"))
    shared = TexturedMesh(tuple(parts))
    copied = TexturedMesh(tuple(dataclasses.replace(part, texture=part.texture.copy()) for part in parts))
    one, two = gather_textures(shared), gather_textures(copied)
    assert len(one.rgba) < len(two.rgba)
    assert np.array_equal(one.cut_out, two.cut_out)
    assert np.array_equal(one.size, two.size)
    for first, second, size in zip(one.start.ravel(), two.start.ravel(), one.size.reshape(-1, 2), strict=True):
        texels = int(size.prod())
        assert np.array_equal(one.rgba[first : first + texels], two.rgba[second : second + texels])
    assert one.last.tolist() == [3, 0, 3]
    assert one.size[0].tolist() == [[13, 8], [6, 4], [3, 2], [1, 1]]
