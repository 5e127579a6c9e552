"""A person is cut out of an opaque picture by the outline of a body."""

import sys

import numpy as np
import pytest
from primdiffusion.reconstruction.posture_masks import cut_out, load_opencv
from scipy import ndimage


def scene() -> tuple[np.ndarray, np.ndarray]:
    """A reddish figure before a greenish wall, and its mask."""
    rows, columns = np.mgrid[:160, :120]
    figure = (np.abs(columns - 60) < 22) & (np.abs(rows - 80) < 60) | (np.hypot(columns - 60, rows - 22) < 14)
    noise = np.random.default_rng(0).integers(-25, 25, (160, 120, 3))
    colours = np.where(figure[..., None], (180, 70, 60), (60, 120, 90)) + noise
    return colours.clip(0, 255).astype(np.uint8), figure


def test_the_edge_is_found_from_an_outline_that_is_off():
    pytest.importorskip("cv2")
    pixels, figure = scene()
    outline = np.roll(ndimage.binary_erosion(figure, iterations=2), 2, axis=1)
    mask = cut_out(pixels, outline)
    assert set(np.unique(mask)) == {0, 255}
    assert ((mask > 0) & figure).sum() / ((mask > 0) | figure).sum() > 0.97
    assert np.array_equal(mask, cut_out(pixels, outline))


def test_specks_of_the_persons_colour_beside_it_are_left():
    pytest.importorskip("cv2")
    pixels, figure = scene()
    pixels[100:104, 85:88] = (180, 70, 60)
    assert not cut_out(pixels, figure)[100:104, 85:88].any()


def test_a_wall_whose_edge_the_outline_covers_is_not_the_person():
    """Between the legs, as wide as the band about the outline: nothing farther away has its colour."""
    pytest.importorskip("cv2")
    pixels, figure = scene()
    rows, columns = np.mgrid[:160, :120]
    gap = (np.abs(columns - 60) < 6) & (rows > 90) & (rows < 140)
    pixels[gap] = (200, 190, 40)
    found = cut_out(pixels, figure & ~ndimage.binary_erosion(gap, iterations=2)) > 0
    assert found[gap].mean() < 0.1
    assert found[figure & ~gap].mean() > 0.97


def test_a_thin_hand_of_the_walls_colour_is_kept_where_the_outline_has_it():
    pytest.importorskip("cv2")
    pixels, figure = scene()
    rows, columns = np.mgrid[:160, :120]
    hand = (np.abs(rows - 80) < 2) & (columns >= 80) & (columns < 95)
    pixels[hand] = (60, 120, 90)
    assert (cut_out(pixels, figure | hand) > 0)[hand & (rows == 80)].mean() > 0.7


def test_without_an_outline_there_is_nobody():
    pytest.importorskip("cv2")
    pixels, figure = scene()
    assert not cut_out(pixels, np.zeros_like(figure)).any()


def test_a_missing_extra_is_one_sentence_that_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ValueError, match=r'install "primdiffusion\[cutout\]"'):
        load_opencv()
