"""Draw an image in bands from the top, so that results show early and drawing can be cancelled between bands."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator

from primdiffusion.drawing.draw import draw_into
from primdiffusion.drawing.scene import Look, Picture, Scene
from primdiffusion.geometry.camera import Camera

BAND_SECONDS = 0.3
"""Target duration of a band, and so the latency of a cancel."""
FIRST_PIXELS = 2**15
"""Pixels in the first band when the drawing speed is unknown."""
MOST_PIXELS = 2**19
"""Pixels in any band; bounds memory, about 100 bytes per pixel."""
GROWTH = 4
"""Largest ratio of rows between consecutive bands: the top of an image is often empty and misleadingly fast."""


@dataclasses.dataclass(frozen=True)
class Progress:
    """Progress of an image."""

    rows: int
    """Finished rows, from the top."""
    seconds_march: float
    """Time spent in the marcher so far."""
    pixels_a_second: float
    """Slowest band of this image, an estimate for the next one; the first band is skipped unless it is the only one,
    because it may include loading compiled code."""


def draw_in_bands(
    picture: Picture, scene: Scene, camera: Camera, look: Look, pixels_a_second: float | None = None
) -> Iterator[Progress]:
    """As `draw`, but fill `picture` in bands from the top; `pixels_a_second` is the measured speed, if known."""
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
