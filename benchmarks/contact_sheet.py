"""A sheet of people generated from successive seeds, front and back; what the default checkpoint makes, unpicked."""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.human import framing, generate, place
from primdiffusion.render.image import over
from primdiffusion.render.march import march
from primdiffusion.training.checkpoint import load_checkpoint

BACKGROUND = (0.72, 0.72, 0.72)


def main() -> None:
    """Generates, draws, saves."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--size", type=int, default=256, help="pixels of each picture")
    parser.add_argument("--columns", type=int, default=4, help="people in a row")
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()

    model = load_checkpoint(arguments.checkpoint)
    seconds, cells = [], []
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.count):
        start = time.perf_counter()
        human = generate(model, seed, arguments.steps)
        seconds.append(time.perf_counter() - start)
        cells.append(_front_and_back(place(human), arguments.size))
    blank = np.full_like(cells[0], cells[0][0, 0, 0])
    cells += [blank] * (-len(cells) % arguments.columns)
    rows = [np.concatenate(cells[i : i + arguments.columns], 1) for i in range(0, len(cells), arguments.columns)]
    Image.fromarray(np.concatenate(rows, 0)).save(arguments.out, optimize=True)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({"seconds_sample": float(np.median(seconds))}))


def _front_and_back(primitives, size: int) -> np.ndarray:
    views = [march(primitives, framing(primitives, yaw, size, size)) for yaw in (0.0, math.pi)]
    picture = torch.cat([encode_srgb(over(view, BACKGROUND)) for view in views], dim=1)
    return (picture.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


if __name__ == "__main__":
    main()
