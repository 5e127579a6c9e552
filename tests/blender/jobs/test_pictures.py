"""The picture of what is being generated."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import bpy
import pytest
from jobs_driven import drive, until_running
from support.fake_child import TAKES_LONG

from blender_primdiffusion.jobs.follow import follow
from blender_primdiffusion.jobs.generate import GenerateJob
from blender_primdiffusion.jobs.pictures import SoFar, so_far
from blender_primdiffusion.jobs.queue import queue

pytestmark = pytest.mark.any_blender
ops = bpy.ops.primdiffusion


def write_png(path: Path, colour: tuple[int, int, int], side: int = 8) -> Path:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = (b"\0" + bytes(colour) * side) * side
    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    )
    return path


def test_pictures_follow_one_another_and_one_at_a_time_is_held(tmp_path):
    picture = SoFar()
    for red in range(0, 200, 40):
        assert picture.show(write_png(tmp_path / f"{red}.png", (red, 0, 0)))
        assert picture._collection["so far"].image_pixels_float[0] == pytest.approx(red / 255, abs=0.01)
        assert len(picture._collection) == 1
    assert not picture.show(picture.shown)
    same = picture.shown
    os.utime(write_png(same, (0, 99, 0)), ns=(1, 1))
    assert picture.show(same), "the same name, written again"
    assert picture._collection["so far"].image_pixels_float[1] == pytest.approx(99 / 255, abs=0.01)
    picture.close()
    picture.close()


def test_a_picture_that_is_gone_or_none_is_no_error(tmp_path):
    picture = SoFar()
    assert not picture.show(None)
    assert not picture.show(tmp_path / "gone.png")
    (tmp_path / "bad.png").write_bytes(b"half a pic")
    picture.show(tmp_path / "bad.png")
    assert (picture.shown, picture.icon) == (None, 0)
    picture.close()


def test_the_childs_picture_is_shown_while_it_works_and_then_no_more(addon):
    queue.add(bpy.context, GenerateJob(TAKES_LONG, {"steps": 5}))
    until_running()
    follow()
    assert so_far.shown.name == "picture.png"
    ops.cancel()
    drive()
    assert so_far.shown is None
