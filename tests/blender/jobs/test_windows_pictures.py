"""Pictures in panels."""

import os
import struct
import zlib
from pathlib import Path

import pytest

from blender_primdiffusion.jobs.windows import Icons

pytestmark = pytest.mark.any_blender


def write_png(path: Path, colour: tuple[int, int, int], side: int = 8) -> Path:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = (b"\0" + bytes(colour) * side) * side
    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    )
    return path


def test_a_picture_that_is_written_again_is_read_again_and_one_that_is_gone_is_let_go(tmp_path):
    icons, path, other = Icons(), tmp_path / "a.png", tmp_path / "b.png"
    for green in (0, 99):
        os.utime(write_png(path, (0, green, 0)), ns=((green + 1) * 10**9,) * 2)
        icons.of(path)
        assert icons._previews[str(path)].image_pixels_float[1] == pytest.approx(green / 255, abs=0.01)
    path.unlink()
    assert icons.of(path) == icons.of(None) == 0
    icons.of(write_png(other, (9, 9, 9)))
    assert list(icons._previews) == [str(other)]
    icons.free()
    icons.free()
