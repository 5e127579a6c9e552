"""Pictures of Cycles that are damaged."""

from __future__ import annotations

import struct
from pathlib import Path

import bpy
import numpy as np
import pytest
from blender_primdiffusion.files.regular_files import FileError
from support.errors import refused

from blender_primdiffusion.capture.passes import read_colours, read_exr
from blender_primdiffusion.files import picture_files

WIDTH, HEIGHT = 6, 4
CHANNELS = tuple(f"ViewLayer.Combined.{name}" for name in "ABGR")


def exr(channels=CHANNELS, window=(0, 0, WIDTH - 1, HEIGHT - 1), lines=range(HEIGHT), fill=0.5) -> bytes:
    def entry(name: bytes, kind: bytes, data: bytes) -> bytes:
        return name + b"\0" + kind + b"\0" + struct.pack("<i", len(data)) + data

    listed = b"".join(name.encode() + b"\0" + struct.pack("<iiii", 2, 0, 1, 1) for name in channels) + b"\0"
    head = struct.pack("<ii", 20000630, 2) + entry(b"channels", b"chlist", listed)
    head += entry(b"compression", b"compression", b"\0")
    head += entry(b"dataWindow", b"box2i", struct.pack("<4i", *window)) + b"\0"
    row = np.full(WIDTH * len(channels), fill, "<f4").tobytes()
    first = len(head) + 8 * HEIGHT
    offsets = [first + k * (8 + len(row)) for k in range(HEIGHT)]
    return head + struct.pack(f"<{HEIGHT}Q", *offsets) + b"".join(struct.pack("<ii", y, len(row)) + row for y in lines)


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def test_nan_is_black(tmp_path):
    path = written(tmp_path / "a.exr", exr(fill=np.nan))
    assert np.isnan(read_exr(path)[CHANNELS[0]]).all()
    colours = read_colours(path)
    assert colours.rgb.shape == (HEIGHT, WIDTH, 3)
    assert not colours.rgb.any()
    assert not colours.alpha.any()


@pytest.mark.parametrize(
    "content",
    [
        exr(window=(0, 0, 2**30, 3)),
        exr(window=(-(2**31), 0, 2**31 - 1, 3)),
        exr(window=(0, 0, 5, 2**30)),
        exr(lines=(1, 1, 1, 1)),
        exr(lines=(0, 2**31 - 1, 1, 2)),
        exr(channels=CHANNELS[:3]),
        exr()[:-1],
        b"",
    ],
    ids=["wide", "wider", "tall", "one line", "far line", "no red", "cut", "empty"],
)  # fmt: skip
def test_a_damaged_picture_is_one_sentence(tmp_path, content):
    path = written(tmp_path / "a.exr", content)
    with refused(FileError, "a.exr") as error:
        read_colours(path)
    assert len(str(error.value)) - len(str(tmp_path)) < 300


@pytest.mark.parametrize("shape", [(1, 1), (16, 5), (37, 53), (64, 48)])
def test_blender_reads_the_numbers_of_an_exr(tmp_path, shape):
    values = np.random.default_rng(0).uniform(0, 50, shape).astype(np.float32)
    values[: shape[0] // 2] = 0
    path = tmp_path / "a.exr"
    picture_files.write_exr(path, values)
    image = bpy.data.images.load(str(path))
    try:
        image.colorspace_settings.name = "Non-Color"
        assert image.is_float
        assert tuple(image.size) == (shape[1], shape[0])
        pixels = np.empty(4 * values.size, np.float32)
        image.pixels.foreach_get(pixels)
    finally:
        bpy.data.images.remove(image)
    assert np.array_equal(pixels.reshape(*shape, 4)[::-1, :, 0], values)
    assert picture_files.is_whole_picture(path)
    with refused(ValueError, str((*shape, 3))):
        picture_files.write_exr(path, np.zeros((*shape, 3)))
