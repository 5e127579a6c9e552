"""Pictures that claim more than they hold."""

import struct
import zlib

import pytest
from PIL import Image
from primdiffusion.geometry.pictures import PictureError, opened_picture


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
    with pytest.raises(PictureError) as raised, opened_picture(path) as picture:
        picture.convert("RGBA")
    assert len(str(raised.value)) < 150


def test_missing_pictures_and_folders_are_errors_of_the_system(tmp_path):
    for path, kind in ((tmp_path / "no.png", FileNotFoundError), (tmp_path, IsADirectoryError)):
        with pytest.raises(kind), opened_picture(path):
            pass


def test_a_picture_is_opened(tmp_path):
    Image.new("RGB", (3, 2)).save(tmp_path / "a.png")
    with opened_picture(tmp_path / "a.png") as picture:
        assert picture.size == (3, 2)
