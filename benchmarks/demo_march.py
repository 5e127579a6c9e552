"""The demo's marched pictures of the generated person: rest, walking, side view, depth, primitives as boxes."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path

import torch
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.drawing.draw import draw
from primdiffusion.drawing.scene import Scene, ViewSettings
from primdiffusion.human import framing, place
from primdiffusion.human_file import load_human
from primdiffusion.primitives.anchors import default_anchors
from primdiffusion.render.image import depth_to_png, rgba_to_png, to_png
from primdiffusion.render.march import march

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from walk import walk_and_wave

BACKGROUND = (0.72, 0.72, 0.72)
SIDE = math.radians(70)


def share_on_body(position: torch.Tensor) -> float:
    """Share of the grid's cells with a distinct point on the body: on a face, 1 mm or more from all others."""
    distance = torch.cdist(position.double(), position.double())
    distance.fill_diagonal_(torch.inf)
    body, anchors = default_body(), default_anchors()
    on_a_face = (anchors.face >= 0) & (anchors.face < body.faces.shape[0]) & (anchors.barycentric >= -1e-6).all(-1)
    return float((on_a_face & (distance.amin(-1) >= 1e-3)).float().mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--human", type=Path, required=True)
    parser.add_argument("--frame", type=int, required=True, help="frame of the walk, counted from 0")
    parser.add_argument("--frames", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--json", type=Path, required=True)
    arguments = parser.parse_args()

    human = load_human(arguments.human)
    rotation = torch.from_numpy(walk_and_wave(arguments.frames)[arguments.frame]).float()
    rest = place(human, None)
    walking = place(human, BodyPose(rotation, torch.zeros(3)))
    front = framing(rest)
    march(rest, front)  # compiles, or loads the compiled code
    start = time.perf_counter()
    rendering = march(rest, front)
    seconds = time.perf_counter() - start

    to_png(arguments.out / "march_rest.png", rendering, BACKGROUND)
    depth_to_png(arguments.out / "march_depth.png", rendering)
    to_png(arguments.out / "march_posed.png", march(walking, framing(walking)), BACKGROUND)
    to_png(arguments.out / "march_side.png", march(walking, framing(walking, yaw=SIDE)), BACKGROUND)
    boxes = draw(Scene(rest, chart=default_anchors().chart), front, ViewSettings("boxes"))
    rgba_to_png(arguments.out / "march_boxes.png", torch.from_numpy(boxes.combined), BACKGROUND)
    share = share_on_body(rest.position)
    arguments.json.write_text(json.dumps({"seconds_march_512": seconds, "grid_share_on_body": share}))


if __name__ == "__main__":
    main()
