"""Pictures that claim more than they hold."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image
from primdiffusion.files.regular_files import FileError
from primdiffusion.geometry.pictures import check_pixels, decoded, opened_picture
from support.errors import refused


def png(width: int, height: int, data: bytes = b"") -> bytes:
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)), (b"IDAT", data), (b"IEND", b"")]
    body = b"".join(struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + body


@pytest.mark.parametrize(
    "content", [png(8192, 8193), png(60_000, 60_000), png(8, 8, b"no zlib"), png(8, 8)[:40], b"", b"GIF89a"]
)
def test_a_picture_that_cannot_be_decoded_is_one_reason(tmp_path, content):
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(ValueError) as raised, opened_picture(path) as picture:
        picture.convert("RGBA")
    assert len(str(raised.value)) < 150


def test_missing_pictures_and_folders_are_errors_of_their_own(tmp_path):
    for path, kind in ((tmp_path / "no.png", FileNotFoundError), (tmp_path, FileError)):
        with pytest.raises(kind), opened_picture(path):
            pass


def test_a_picture_is_opened(tmp_path):
    Image.new("RGB", (3, 2)).save(tmp_path / "a.png")
    with opened_picture(tmp_path / "a.png") as picture:
        assert picture.size == (3, 2)


def test_a_large_picture_in_a_small_file_is_rejected_by_its_header_and_a_large_file_may_have_it(tmp_path):
    small = 100_000
    check_pixels(6400, 6400, small, 4)
    check_pixels(8192, 8192, small, 1)
    check_pixels(8192, 8192, 2_000_000, 4)  # the texture of a scan
    with refused(ValueError, "100000"):
        check_pixels(8192, 8192, small, 4)
    path = tmp_path / "a.png"
    path.write_bytes(png(8000, 8000, b"no zlib"))  # would be another error if it were decoded
    with refused(ValueError, "8000"), opened_picture(path):
        pass


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "I;16"])
@pytest.mark.parametrize("wanted", ["RGBA", "RGB", "L"])
def test_decoded_pictures_are_pillows(tmp_path, mode, wanted):
    if mode == "I;16" and wanted != "L":
        pytest.skip("Pillow does not convert these")
    rng = np.random.default_rng(0)
    colour = Image.fromarray(rng.integers(0, 256, (23, 17, 4), dtype=np.uint8), "RGBA")
    if mode == "I;16":
        picture = Image.fromarray(rng.integers(0, 256, (23, 17), dtype=np.uint16))
    else:
        picture = colour if mode == "RGBA" else colour.convert("RGB").convert(mode)
    picture.save(tmp_path / "a.png")
    with opened_picture(tmp_path / "a.png") as opened:
        result = decoded(opened, wanted)
    assert result.dtype == np.uint8
    assert np.array_equal(result, np.asarray(Image.open(tmp_path / "a.png").convert(wanted)))


def test_a_progressive_jpeg_is_read(tmp_path):
    path = tmp_path / "a.jpg"
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path, progressive=True)
    with opened_picture(path) as picture:
        assert decoded(picture, "RGB").shape == (64, 64, 3)
