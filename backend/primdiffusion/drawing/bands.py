"""A picture in bands from the top, so that something shows early and each band leaves a chance to stop."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator

from primdiffusion.drawing.draw import draw_into
from primdiffusion.drawing.scene import Look, Picture, Scene
from primdiffusion.geometry.camera import Camera

BAND_SECONDS = 0.3
"""What a band should take at most: a cancelled picture stops that soon."""
FIRST_PIXELS = 2**15
"""Of the first band while nobody knows how fast drawing is."""
MOST_PIXELS = 2**19
"""Of any band: bounds the memory, some 100 bytes a pixel."""
GROWTH = 4
"""A band has at most this many times the last one's rows: the top of a picture is often empty and quickly done."""


@dataclasses.dataclass(frozen=True)
class Progress:
    """How far a picture has come."""

    rows: int
    """Finished, from the top."""
    seconds_march: float
    """Of the marcher alone, so far."""
    pixels_a_second: float
    """The least seen in this picture, but for its first band, which may have loaded compiled code; what the next
    picture of the kind may reckon with."""


def draw_in_bands(
    picture: Picture, scene: Scene, camera: Camera, look: Look, pixels_a_second: float | None = None
) -> Iterator[Progress]:
    """Fills `picture` with what `draw` gives, in bands from the top; `pixels_a_second` of one before, where known."""
    top, rows, seconds = 0, camera.height, 0.0
    speeds: list[float] = []
    while top < camera.height:
        rows = min(_rows(camera.width, pixels_a_second), rows * GROWTH, camera.height - top)
        began = time.perf_counter()
        part = camera.crop(0, top, camera.width, rows)
        seconds += draw_into(picture.rows(top, top + rows), scene, part, look)
        pixels_a_second = rows * camera.width / max(time.perf_counter() - began, 1e-6)
        speeds.append(pixels_a_second)
        top += rows
        yield Progress(top, seconds, min(speeds[1:] or speeds))


def _rows(width: int, pixels_a_second: float | None) -> int:
    pixels = FIRST_PIXELS if pixels_a_second is None else min(BAND_SECONDS * pixels_a_second, MOST_PIXELS)
    return max(int(pixels / width), 1)
