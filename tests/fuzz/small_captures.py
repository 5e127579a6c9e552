"""Captures whose views claim much in small files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from fuzz.claims import COLOUR, GREY, png

BITS = {"depth": 16}
"""Of a pass; others have 8."""


def captured_view(side: int, *passes: str) -> Callable[[Path], Path]:
    """A dataset of one view, whose pictures of these passes are black, `side` pixels wide and high."""

    def make(folder: Path) -> Path:
        from capture_scenes import captured
        from primdiffusion.formats import capture_layout

        root = captured(folder / "dataset", people=1, frames=1)
        about = root / capture_layout.DATASET_FILE
        about.write_text(json.dumps({**json.loads(about.read_text()), "passes": passes}))
        person = next(root.glob("*/cameras.json")).parent
        for kind in passes:
            colour = COLOUR if kind in ("img", "normal") else GREY
            picture = capture_layout.picture_path(person, kind, 0, 0)
            picture.write_bytes(png(side, side, colour, BITS.get(kind, 8)))
        return capture_layout.picture_path(person, "img", 0, 0)

    return make


def small_view(folder: Path) -> Path:
    return captured_view(64, "img", "mask", "depth", "normal", "part")(folder)


def read_view(path: Path) -> object:
    from primdiffusion.capture.reader import open_captures

    captures = open_captures(path.parents[3])
    return captures.view(captures.subjects[0], 0, 0)


def read_rgba(path: Path) -> object:
    from primdiffusion.capture.reader import open_captures

    captures = open_captures(path.parents[3])
    return captures.subject(captures.subjects[0]).rgba(0, 0)
