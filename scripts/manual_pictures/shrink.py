"""Saves small files: PNGs of panels and GIFs with few colours, JPEGs of people."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

MOST_BYTES = 120_000
"""The limit for a still picture of the manual."""


def save_png(image: Image.Image, path: Path) -> None:
    """With 256 colours, means of what they stand for: panels, with small people. Raises ValueError above MOST_BYTES."""
    few = image.convert("RGB").quantize(256, Image.Quantize.MEDIANCUT, kmeans=1, dither=Image.Dither.NONE)
    few.save(path, optimize=True)
    _check(path, image)


def save_jpeg(image: Image.Image, path: Path) -> None:
    """For pictures with people. Raises ValueError above MOST_BYTES."""
    image.convert("RGB").save(path, quality=88, optimize=True, progressive=True)
    _check(path, image)


def _check(path: Path, image: Image.Image) -> None:
    size = path.stat().st_size
    if size > MOST_BYTES:
        path.unlink()
        raise ValueError(f"{path.name} has {size} bytes and may have {MOST_BYTES}: crop or scale it")
    print(f"{path.name}: {image.width} x {image.height}, {size / 1e3:.0f} kB")


def save_gif(pictures: list[Path], path: Path, milliseconds: int, colours: int = 256) -> None:
    """An endless loop, with one palette for all frames and unchanged pixels left out."""
    frames = [Image.open(picture).convert("RGB") for picture in pictures]
    sample = Image.fromarray(np.concatenate([np.asarray(frame) for frame in frames[:: max(1, len(frames) // 4)]]))
    palette = sample.quantize(colours, Image.Quantize.MEDIANCUT)
    few = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    few[0].save(path, save_all=True, append_images=few[1:], duration=milliseconds, loop=0, optimize=True)
    print(f"{path.name}: {len(few)} frames, {path.stat().st_size / 1e3:.0f} kB")
