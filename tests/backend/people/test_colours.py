"""Colours, patterns and texel maps of people, without asset files."""

import numpy as np
import pytest
from primdiffusion.people.colours import bytes_from_lab, hair_colour, is_vivid, lab_from_bytes
from primdiffusion.people.fitting import connected_faces, uv_islands
from primdiffusion.people.garments import PATTERNS, SHOULDER_X, SHOULDER_Y, hanging_height, paint_garment
from primdiffusion.people.wardrobe import OUTFITS, stream
from primdiffusion.raster.uv_atlas import texel_map
from support.errors import refused

SQUARE = np.array([[[0.0, 0], [0.5, 0], [0.5, 0.5]], [[0, 0], [0.5, 0.5], [0, 0.5]]])


def test_lab_agrees_with_scikit_image():
    reference = pytest.importorskip("skimage.color", reason="needs scikit-image")
    colours = np.random.default_rng(0).integers(0, 256, (500, 3)).astype(np.uint8)
    assert np.abs(lab_from_bytes(colours) - reference.rgb2lab(colours[None])[0]).max() < 0.02
    lab = reference.rgb2lab(colours[None])[0].astype(np.float32)
    assert np.abs(bytes_from_lab(lab) / 255 - reference.lab2rgb(lab[None])[0]).max() < 1.01 / 255


def test_lab_round_trip_is_off_by_at_most_one():
    colours = np.stack(np.meshgrid(*[np.arange(0, 256, 5, dtype=np.uint8)] * 3), -1).reshape(-1, 3)
    assert np.abs(bytes_from_lab(lab_from_bytes(colours)).astype(int) - colours).max() <= 1


def test_texel_map_puts_v_up_and_interpolates():
    texels = texel_map(SQUARE, 8)
    assert texels.inside[4:, :4].all()
    assert texels.inside.sum() == 16
    vertices = np.array([[0.0, 0], [0.5, 0], [0.5, 0.5], [0, 0.5]])
    uv = texels.sample(vertices, np.array([[0, 1, 2], [0, 2, 3]]))
    assert uv[5, 2] == pytest.approx([2.5 / 8, 1 - 5.5 / 8], abs=1e-6)


def test_texels_outside_take_the_nearest_island():
    corner_uv = np.concatenate([SQUARE * 0.5, SQUARE * 0.5 + 0.75])
    texels = texel_map(corner_uv, 32)
    assert set(np.unique(texels.face[-4:, :4])) <= {0, 1}
    assert set(np.unique(texels.face[:4, -4:])) <= {2, 3}


def test_mesh_without_texture_coordinates_is_rejected():
    with refused(ValueError, "coordinates"):
        texel_map(np.zeros((3, 3, 2)), 16)


def test_connected_pieces_are_numbered_from_the_largest():
    faces = np.array([[0, 1, 2], [3, 4, 5], [4, 5, 6]])
    assert connected_faces(faces, 7).tolist() == [1, 0, 0]


def test_islands_part_where_texture_coordinates_do():
    corner_uv = np.concatenate([SQUARE, SQUARE[:1] + 0.3])
    assert uv_islands(corner_uv).tolist() == [0, 0, 1]


@pytest.mark.parametrize("name", PATTERNS)
def test_patterns_show_both_colours_and_are_mirror_symmetric(name):
    kind, pattern = PATTERNS[name]
    draws = np.random.default_rng(1)
    position = draws.uniform((-0.6, -0.8 if kind == "denim" else -0.1, -0.2), (0.6, 0.5, 0.2), (8000, 3))
    share = pattern(position)
    assert share.min() == 0
    assert share.max() == pytest.approx(1, abs=0.05)
    mirrored = pattern(position * [-1, 1, 1])
    assert np.abs(share - mirrored).max() < 1e-9, name


def test_bands_run_on_from_body_to_sleeve():
    body = np.array([[SHOULDER_X - 1e-6, SHOULDER_Y, 0.0]])
    sleeve = np.array([[SHOULDER_X + 1e-6, SHOULDER_Y, 0.0]])
    assert hanging_height(body) == pytest.approx(hanging_height(sleeve), abs=1e-5)


@pytest.mark.parametrize("tone", [0.0, 0.3, 1.0])
def test_hair_shares_are_those_of_the_tone(tone):
    draws = np.random.default_rng(2)
    names = [hair_colour(tone, "young", draws)[0] for _ in range(600)]
    dark = sum(name in ("black", "darkbrown") for name in names) / 600
    assert dark == pytest.approx({0.0: 0.371, 0.3: 0.615, 1.0: 0.884}[tone], abs=0.06)


def test_hair_turns_grey_with_age():
    draws = np.random.default_rng(3)
    grey = {
        age: sum(hair_colour(0.3, age, draws)[0] in ("grey", "white") for _ in range(600)) / 600
        for age in ("young", "middleage", "old")
    }
    assert grey == {"young": 0, "middleage": pytest.approx(0.127, abs=0.05), "old": pytest.approx(0.555, abs=0.06)}


def test_at_most_one_garment_in_six_is_printed_and_at_most_one_colour_of_an_outfit_is_vivid():
    outfits = [*OUTFITS["female"]]
    paints = [paint_garment(each, stream(seed, "x")) for seed in range(50) for each in outfits]
    garments = [paint for each in paints for paint in set(each)]
    assert sum(paint.pattern in PATTERNS for paint in garments) / len(garments) < 1 / 6
    vivid = [sum(is_vivid(paint.main) for paint in set(each)) for each in paints]
    assert np.mean(np.array(vivid) > 1) < 0.1  # denim may be blue beside a vivid top
