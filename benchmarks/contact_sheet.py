"""A sheet of humans generated from consecutive seeds by the default checkpoint, not hand-picked.

All from the front with lowered arms; then, of the first seeds, depth, full bodies at 512 x 512 pixels in T pose, and
heads. `--json` saves the median seconds per human.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from primdiffusion.body.model import BodyPose
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.camera import Camera
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.human import Human, framing, generate, place
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.image import depth_colours
from primdiffusion.render.march import march

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts.feature_space.portraits import PORTRAITS, camera_of

BACKGROUND = (0.72, 0.72, 0.72)
LARGE = 512
HEAD = next(portrait for portrait in PORTRAITS if portrait.name == "head")
Picture = Callable[[Human], np.ndarray]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=64)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--columns", type=int, default=16, help="people in a row of small pictures")
    parser.add_argument("--width", type=int, default=2048, help="pixels of the sheet")
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()

    model = load_checkpoint(arguments.checkpoint)
    seconds, people = [], []
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.count):
        start = time.perf_counter()
        people.append(generate(model, seed, arguments.steps))
        seconds.append(time.perf_counter() - start)
    Image.fromarray(sheet(people, arguments.columns, arguments.width)).save(arguments.out, optimize=True)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({"seconds_sample": float(np.median(seconds))}), encoding="utf-8")


def sheet(people: list[Human], columns: int, width: int) -> np.ndarray:
    """The sheet, sRGB bytes [height, width, 3], with so many small pictures in a row."""
    columns = min(columns, len(people))
    tall = (width // columns, width // columns * 7 // 4)
    large = min(width // LARGE, len(people))
    rows = [
        *grid(people, columns, width, lambda human: relaxed(human, *tall)),
        *grid(people[:columns], columns, width, lambda human: relaxed_depth(human, *tall)),
        *grid(people[:large], large, width, lambda human: whole(human, width // large)),
        *grid(people[: 2 * large], 2 * large, width, lambda human: head(human, width // (2 * large))),
    ]
    return np.concatenate(rows, 0)


def grid(people: list[Human], columns: int, width: int, picture: Picture) -> list[np.ndarray]:
    """Rows of pictures, the last one filled up, widened to the sheet with the colour of a corner."""
    cells = [picture(human) for human in people]
    blank = np.broadcast_to(cells[0][:1, :1], cells[0].shape)
    cells += [blank] * (-len(cells) % columns)
    rows = [np.concatenate(cells[i : i + columns], 1) for i in range(0, len(cells), columns)]
    return [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), mode="edge") for row in rows]


def lowered_arms() -> BodyPose:
    """The T pose with arms at 60 degrees below the horizon: people fit into narrow pictures."""
    theta = torch.zeros(len(JOINT_NAMES), 3)
    theta[JOINT_NAMES.index("left_shoulder"), 2] = -math.radians(60)
    theta[JOINT_NAMES.index("right_shoulder"), 2] = math.radians(60)
    return BodyPose.from_axis_angle(theta.flatten())


def relaxed(human: Human, width: int, height: int) -> np.ndarray:
    primitives = place(human, lowered_arms())
    return seen(primitives, framing(primitives, 0.0, width, height))


def relaxed_depth(human: Human, width: int, height: int) -> np.ndarray:
    """Expected depth from the front, bright where near, on black."""
    primitives = place(human, lowered_arms())
    view = march(primitives, framing(primitives, 0.0, width, height))
    depth, alpha = view.depth.double().numpy(), view.alpha.double().numpy()
    solid = depth[alpha >= 0.5]
    colour = depth_colours(depth, float(solid.min()), float(solid.max())) * alpha[..., None]
    return (colour * 255).round().astype(np.uint8)


def whole(human: Human, size: int) -> np.ndarray:
    """In T pose, a little from the side."""
    primitives = place(human)
    return seen(primitives, framing(primitives, 17, size, size))


def head(human: Human, size: int) -> np.ndarray:
    """The camera that heads are compared by."""
    return seen(place(human), camera_of(HEAD, size))


def seen(primitives: Primitives, camera: Camera) -> np.ndarray:
    """sRGB bytes over the background."""
    picture = encode_srgb(march(primitives, camera).over(BACKGROUND))
    return (picture.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


if __name__ == "__main__":
    main()
