"""Plain pictures: what is kept of them, and which are refused."""

import numpy as np
import pytest
from PIL import Image
from primdiffusion.capture.photograph import LARGEST_SIDE, read_photographs
from primdiffusion.files.regular_files import FileError
from scipy import ndimage
from support.errors import refused

RED, GREEN = (200, 30, 30), (30, 200, 30)


def figure(width=200, height=160, box=(60, 20, 100, 140), colour=RED):
    """A red figure with a green left half on white, and its mask."""
    left, top, right, bottom = box
    picture = np.full((height, width, 3), 255, np.uint8)
    picture[top:bottom, left:right] = colour
    picture[top:bottom, left : (left + right) // 2] = GREEN
    mask = np.zeros((height, width), np.uint8)
    mask[top:bottom, left:right] = 255
    return picture, mask


def save(path, pixels, **more):
    Image.fromarray(pixels).save(path, **more)
    return path


def cut_out(path, picture, mask, **more):
    return save(path, np.concatenate([picture, mask[..., None]], -1), **more)


def test_alpha_and_a_mask_file_say_the_same(tmp_path):
    picture, mask = figure()
    (alpha,) = read_photographs([cut_out(tmp_path / "a.png", picture, mask)])
    white, masked = save(tmp_path / "b.png", picture), save(tmp_path / "m.png", mask)
    (by_mask,) = read_photographs([white], [masked])
    assert np.array_equal(alpha.rgba, by_mask.rgba)
    assert (alpha.width, alpha.height, alpha.focal) == (200, 160, None)
    side = len(alpha.rgba)
    assert alpha.rgba.shape == (side, side, 4)
    assert abs((alpha.rgba[..., 3] > 127).sum() - 40 * 120 * (side / alpha.window.width) ** 2) < 3 * side
    assert not alpha.rgba[alpha.rgba[..., 3] == 0].any()


def test_the_square_around_the_person_is_what_the_window_says(tmp_path):
    picture, mask = figure(box=(150, 30, 190, 150))
    (found,) = read_photographs([cut_out(tmp_path / "a.png", picture, mask)])
    covered = found.rgba[..., 3] > 127
    scale = found.window.width / len(covered)
    rows, columns = np.flatnonzero(covered.any(1)), np.flatnonzero(covered.any(0))
    edges = [found.window.left + scale * columns[0], found.window.left + scale * (columns[-1] + 1)]
    edges += [found.window.top + scale * rows[0], found.window.top + scale * (rows[-1] + 1)]
    assert edges == pytest.approx([150, 190, 30, 150], abs=1.5 * scale)


@pytest.mark.parametrize("box", [(60, 20, 101, 141), (150, 30, 190, 151)])
def test_the_mask_of_a_square_lies_in_the_picture_where_it_was(tmp_path, box):
    """Windows do not begin at whole pixels."""
    picture, mask = figure(box=box)
    (found,) = read_photographs([cut_out(tmp_path / "a.png", picture, mask)])
    whole = found.whole_mask()
    assert whole.shape == mask.shape
    assert ndimage.center_of_mass(whole) == pytest.approx(ndimage.center_of_mass(mask), abs=0.02)
    assert np.array_equal(whole > 127, mask > 127)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_upright_as_exif_says(tmp_path, orientation):
    picture, mask = figure()
    stored = Image.fromarray(np.concatenate([picture, mask[..., None]], -1))
    undo = {
        2: [Image.Transpose.FLIP_LEFT_RIGHT], 3: [Image.Transpose.ROTATE_180], 4: [Image.Transpose.FLIP_TOP_BOTTOM],
        5: [Image.Transpose.TRANSPOSE], 6: [Image.Transpose.ROTATE_90], 7: [Image.Transpose.TRANSVERSE],
        8: [Image.Transpose.ROTATE_270],
    }  # fmt: skip
    for step in undo.get(orientation, []):
        stored = stored.transpose(step)
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored.save(tmp_path / "turned.png", exif=exif)
    (turned,) = read_photographs([tmp_path / "turned.png"])
    (upright,) = read_photographs([cut_out(tmp_path / "a.png", picture, mask)])
    assert np.array_equal(turned.rgba, upright.rgba)
    assert (turned.width, turned.height) == (200, 160)


def test_the_lens_of_exif_is_used(tmp_path):
    picture, mask = figure()
    exif = Image.Exif()
    exif[0x8769] = {0xA405: 50}
    (found,) = read_photographs([cut_out(tmp_path / "a.png", picture, mask, exif=exif)])
    assert found.lens().intrinsics[0, 0] == pytest.approx(200 * 50 / 36)


def test_large_pictures_are_scaled_and_tiny_ones_kept(tmp_path):
    picture, mask = figure(2400, 3000, (600, 100, 1500, 2900))
    (large,) = read_photographs([cut_out(tmp_path / "a.png", picture, mask)])
    picture, mask = figure(20_000, 200, (15_000, 40, 15_060, 180))
    (wide,) = read_photographs([cut_out(tmp_path / "w.png", picture, mask)])
    assert (wide.rgba[..., 3] > 127).sum() == pytest.approx(60 * 140, rel=0.05)
    picture, mask = figure(40, 50, (12, 5, 28, 45))
    (tiny,) = read_photographs([cut_out(tmp_path / "b.png", picture, mask)])
    assert large.rgba.shape == (LARGEST_SIDE, LARGEST_SIDE, 4)
    assert len(tiny.rgba) < 60


def test_specks_in_the_mask_are_ignored_and_parts_are_not(tmp_path):
    picture, mask = figure()
    mask[2:4, 190:192] = 255
    mask[80:90, 60:100] = 0
    (found,) = read_photographs([cut_out(tmp_path / "a.png", picture, mask)])
    (whole,) = read_photographs([cut_out(tmp_path / "b.png", *figure())])
    assert found.window == whole.window
    covered = (found.rgba[..., 3] > 127).sum() / (whole.rgba[..., 3] > 127).sum()
    assert covered == pytest.approx(110 / 120, abs=0.01)


def pixels(height, width, value):
    return np.full((height, width), value, np.uint8)


def two_people():
    mask = pixels(160, 200, 0)
    mask[20:140, 20:60] = mask[20:140, 120:160] = 255
    return mask


def dim():
    return (ndimage.gaussian_filter(figure()[1].astype(float), 9.0) / 3).astype(np.uint8)


@pytest.mark.parametrize(
    ("mask", "word"),
    [
        (pixels(160, 200, 0), "no person"),
        (dim(), "half covered"),
        (two_people(), "2 separate figures"),
        (pixels(160, 201, 255), "201 x 160"),
    ],
)
def test_masks_of_nobody_two_people_or_another_size_are_refused(tmp_path, mask, word):
    picture = save(tmp_path / "a.jpg", figure()[0])
    with refused(FileError, str(tmp_path / "m.png"), word):
        read_photographs([picture], [save(tmp_path / "m.png", mask)])


def palette(labels, *colours):
    image = Image.fromarray(labels, "P")
    image.putpalette([channel for colour in colours for channel in colour])
    return image


LABELS = np.zeros((160, 200))
LABELS[10:18, 110:190], LABELS[20:140, 60:100] = 1, 15
"""A figure of label 15, and something else beside it."""


@pytest.mark.parametrize(
    "mask",
    [
        Image.fromarray(LABELS.astype(np.uint8)),
        Image.fromarray(LABELS.astype(np.uint16)),
        palette(LABELS.astype(np.uint8), *[(8 * i, 0, 128 - 8 * i) for i in range(16)]),
    ],
)
def test_in_a_mask_of_labels_the_person_is_what_has_the_named_one(tmp_path, mask):
    mask.save(tmp_path / "m.png")
    picture, white = figure()
    pair = [save(tmp_path / "a.png", picture)], [tmp_path / "m.png"]
    for label in (None, 3):
        with refused(FileError, "m.png", "label"):
            read_photographs(*pair, mask_label=label)
    (found,) = read_photographs(*pair, mask_label=15)
    (expected,) = read_photographs(pair[0], [save(tmp_path / "white.png", white)])
    assert np.array_equal(found.rgba, expected.rgba)


@pytest.mark.parametrize("name", ["m.png", "m.jpg", "m16.png"])
def test_masks_may_have_soft_edges(tmp_path, name):
    picture, mask = figure()
    soft = ndimage.gaussian_filter(mask.astype(float), 2.0).round()
    soft = soft.astype(np.uint8) if "16" not in name else (soft * 257).astype(np.uint16)
    pair = [save(tmp_path / "a.png", picture)], [save(tmp_path / name, soft)]
    (found,) = read_photographs(*pair)
    assert 20 < len(np.unique(found.rgba[..., 3])) <= 256
    (hard,) = read_photographs([save(tmp_path / "a.png", picture)], [save(tmp_path / "hard.png", mask)])
    assert abs(found.rgba[..., 3].mean() - hard.rgba[..., 3].mean()) < 10


def test_pictures_that_tell_nobody_are_refused(tmp_path):
    picture, mask = figure()
    with refused(FileError, "a.jpg", "alpha", "mask"):
        read_photographs([save(tmp_path / "a.jpg", picture)])
    with refused(FileError, "b.png", "opaque"):
        read_photographs([cut_out(tmp_path / "b.png", picture, np.full_like(mask, 255))])
    with refused(FileError, "c.png", "1 pixels tall", "1 x 1"):
        one = save(tmp_path / "c.png", pixels(1, 1, 255))
        read_photographs([one], [one])
    with refused(FileError, "d.png", "12 pixels tall"):
        read_photographs([cut_out(tmp_path / "d.png", *figure(40, 50, (10, 5, 20, 17)))])
    with refused(ValueError, "2 masks", "1 pictures"):
        read_photographs([tmp_path / "a.jpg"], [tmp_path / "a.jpg"] * 2)


def test_pictures_of_400_megapixels_are_refused_before_they_are_decoded(tmp_path):
    Image.new("1", (20_000, 20_000)).save(tmp_path / "a.png")
    with refused(FileError, "a.png", "400000000"):
        read_photographs([tmp_path / "a.png"])
