"""Fitting proxy files, checked on a base mesh small enough to reckon by hand."""

import numpy as np
import pytest
from PIL import Image
from primdiffusion.files.regular_files import FileError
from primdiffusion.people.assets import _decoded, parse_mhclo, parse_obj, read_pair
from support.errors import refused

BASE = np.array([[0.0, 0, 0], [2, 0, 0], [0, 4, 0], [0, 0, 6], [1, 1, 1]])
MHCLO = """# a comment
basemesh hm08
name two words
obj_file hat.obj
x_scale 0 1 4.0
y_scale 0 2 2.0
z_scale 3 0 6.0
z_depth 7
verts 0
material hat.mhmat
4
0 1 2 0.5 0.25 0.25 1.0 -1.0 0.5
0 1 3 0.2 0.3 0.5
delete_verts
0 2 - 4
1
"""
OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n"


def test_single_index_rides_on_that_vertex():
    assert parse_mhclo(MHCLO).fit(BASE)[0] == pytest.approx(BASE[4])


def test_three_indices_blend_and_offset_scales_per_axis():
    # 0.5 v0 + 0.25 v1 + 0.25 v2 = (0.5, 1, 0); sizes are 2/4, 4/2, 6/6; offsets 1, -1, 0.5.
    assert parse_mhclo(MHCLO).fit(BASE)[1] == pytest.approx([0.5 + 0.5, 1 - 2, 0.5])


def test_line_of_six_values_has_no_offset():
    assert parse_mhclo(MHCLO).fit(BASE)[2] == pytest.approx([0.6, 0, 3])


def test_turn_rotates_the_scaled_offset_only():
    quarter = np.broadcast_to(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), (3, 3, 3))
    assert parse_mhclo(MHCLO).fit(BASE, quarter)[1] == pytest.approx([0.5 + 2, 1 + 0.5, 0.5])


def test_without_scale_lines_offsets_are_in_the_unit_of_the_base():
    proxy = parse_mhclo("verts 0\n0 1 2 1 0 0 0.1 0.2 0.3\n")
    assert proxy.fit(BASE)[0] == pytest.approx([0.1, 0.2, 0.3])


def test_delete_ranges_include_both_ends_and_keys_after_verts_are_read():
    proxy = parse_mhclo(MHCLO)
    assert proxy.delete_vertices.tolist() == [0, 1, 2, 3, 4]
    assert (proxy.name, proxy.z_depth, len(proxy.reference)) == ("two words", 7, 3)


def test_proxy_vertex_is_hidden_only_if_all_its_references_are():
    hidden = np.array([True, True, True, False, False])
    assert parse_mhclo(MHCLO).hidden_by(hidden).tolist() == [False, True, False]


@pytest.mark.parametrize("text", ["name x\nverts 0\n", "verts 0\n1 2 3 4\n"])
def test_damaged_mhclo_is_rejected(text):
    with pytest.raises(ValueError):
        parse_mhclo(text)


def test_polygons_become_fans_with_their_own_texture_coordinates():
    mesh = parse_obj(OBJ)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.corner_uv[1].tolist() == [[0, 0], [1, 1], [0, 1]]


def test_faces_that_name_missing_vertices_are_rejected():
    with refused(ValueError, "1 vertices"):
        parse_obj("v 0 0 0\nf 1 2 3\n")


def test_files_of_different_size_are_rejected_with_both_counts(tmp_path):
    (tmp_path / "a.mhclo").write_text(MHCLO)
    (tmp_path / "a.obj").write_text(OBJ)
    with refused(FileError, "a.mhclo", "a.obj", "3 vertices"):
        read_pair(tmp_path / "a.mhclo", tmp_path / "a.obj")


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_a_shrunk_picture_is_pillows(tmp_path, mode):
    noise = np.random.default_rng(0).integers(0, 256, (301, 207, 4), dtype=np.uint8)
    Image.fromarray(noise).convert(mode).save(tmp_path / "a.png")
    whole = Image.fromarray(noise).convert(mode).convert("RGBA").convert("RGBa")
    expected = whole.resize((50, round(301 * 50 / 207)), Image.Resampling.BOX).convert("RGBA")
    assert np.array_equal(_decoded(tmp_path / "a.png", 50), np.asarray(expected))


def test_a_picture_that_claims_more_than_its_file_can_hold_is_rejected(tmp_path):
    Image.new("1", (8000, 8000)).save(tmp_path / "a.png")
    with refused(FileError, "a.png", "8000"):
        _decoded(tmp_path / "a.png", 50)
