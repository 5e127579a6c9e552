"""PNGs of one channel that this project has written are read without an imaging library, to the same values."""

import io
import zlib

import numpy as np
import pytest
from PIL import Image
from primdiffusion.formats.picture_files import read_grey_png, write_png

KINDS = (np.uint8, np.uint16)


def written(path, pixels) -> bytes:
    write_png(path, pixels)
    return path.read_bytes()


@pytest.mark.parametrize("kind", KINDS)
def test_what_was_written_is_read_as_pillow_reads_it(tmp_path, kind):
    rng = np.random.default_rng(2)
    for height, width in ((1, 1), (1, 9), (7, 1), (33, 20), (300, 200)):
        for most in (1, 3, np.iinfo(kind).max + 1):
            pixels = rng.integers(0, most, (height, width)).astype(kind)
            content = written(tmp_path / "a.png", pixels)
            found = read_grey_png(io.BytesIO(content), width, height, kind)
            assert found is not None
            assert found.dtype == kind
            assert found.flags.writeable
            assert np.array_equal(found, pixels)
            assert np.array_equal(found, np.asarray(Image.open(tmp_path / "a.png")))


@pytest.mark.parametrize("kind", KINDS)
def test_a_changed_or_missing_byte_is_noticed(tmp_path, kind):
    pixels = np.arange(12 * 10).reshape(12, 10).astype(kind)
    content = written(tmp_path / "a.png", pixels)
    for place in range(len(content)):
        changed = bytearray(content)
        changed[place] ^= 4
        assert read_grey_png(io.BytesIO(changed), 10, 12, kind) is None
        assert read_grey_png(io.BytesIO(content[:place]), 10, 12, kind) is None
    assert read_grey_png(io.BytesIO(content + b"0"), 10, 12, kind) is None


def test_other_pictures_are_left_to_imaging_libraries(tmp_path):
    grey = np.arange(30, dtype=np.uint8).reshape(5, 6)
    content = written(tmp_path / "grey.png", grey)
    for width, height, kind in ((5, 6, np.uint8), (6, 4, np.uint8), (6, 5, np.uint16), (3, 5, np.uint16)):
        assert read_grey_png(io.BytesIO(content), width, height, kind) is None
    colour = written(tmp_path / "colour.png", np.stack([grey] * 3, axis=-1))
    assert read_grey_png(io.BytesIO(colour), 6, 5, np.uint8) is None
    Image.fromarray(np.tile(grey, (40, 40))).save(tmp_path / "filtered.png")
    assert read_grey_png(io.BytesIO((tmp_path / "filtered.png").read_bytes()), 240, 200, np.uint8) is None


def test_more_or_fewer_pixels_than_the_header_says_are_noticed(tmp_path, monkeypatch):
    compress = zlib.compress
    for change in (lambda data: data + b"\0", lambda data: data[:-1], lambda data: data + bytes(2**24)):
        monkeypatch.setattr(zlib, "compress", lambda data, level, change=change: compress(change(data), level))
        content = written(tmp_path / "a.png", np.zeros((8, 8), np.uint8))
        assert read_grey_png(io.BytesIO(content), 8, 8, np.uint8) is None
