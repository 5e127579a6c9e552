"""Small files of pictures: PNGs and GIFs of few colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

MOST_BYTES = 120_000
"""Of a PNG of the manual."""


def save_png(image: Image.Image, path: Path, most_bytes: int = MOST_BYTES) -> None:
    """With as many of 256 colours as fit `most_bytes`. Raises ValueError where not even 32 do."""
    for colours in (256, 192, 128, 96, 64, 48, 32):
        few = image.convert("RGB").quantize(colours, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        few.save(path, optimize=True)
        if path.stat().st_size <= most_bytes:
            print(f"{path.name}: {few.size[0]} x {few.size[1]}, {colours} colours, {path.stat().st_size / 1e3:.0f} kB")
            return
    size = path.stat().st_size
    path.unlink()
    raise ValueError(
        f"{path.name} takes {size} bytes with 32 colours and {most_bytes} are wanted: crop it, or scale it"
    )


def save_gif(pictures: list[Path], path: Path, milliseconds: int, colours: int = 256) -> None:
    """A loop for ever, one palette for all frames, what stays the same left out."""
    frames = [Image.open(picture).convert("RGB") for picture in pictures]
    sample = Image.fromarray(np.concatenate([np.asarray(frame) for frame in frames[:: max(1, len(frames) // 4)]]))
    palette = sample.quantize(colours, Image.Quantize.MEDIANCUT)
    few = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    few[0].save(path, save_all=True, append_images=few[1:], duration=milliseconds, loop=0, optimize=True)
    print(f"{path.name}: {len(few)} frames, {path.stat().st_size / 1e3:.0f} kB")
