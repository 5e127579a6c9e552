"""The demo's pictures without Blender: the generated human by the marcher, and a contact sheet of others.

It also compares the vertices that Blender has skinned to the body's own. One process: torch starts once.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import contact_sheet
import numpy as np
import torch
from PIL import Image
from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.drawing import Scene, ViewSettings, draw
from primdiffusion.human import Human, framing, generate, place
from primdiffusion.human_file import load_human
from primdiffusion.primitives.anchors import default_anchors
from primdiffusion.render.image import depth_to_png, rgba_to_png
from primdiffusion.render.march import march

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from walk import walk_and_wave

BACKGROUND = contact_sheet.BACKGROUND
DRAFT = (8, "dpmpp_2m")
"""Steps and sampler of the sheet: 45 to 51 dB from 30 steps of DDIM, in a quarter of the time."""
SHEET_PX = 2048


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("human", "skinned", "out", "json"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--frames", type=int, required=True)
    parser.add_argument("--frame", type=int, required=True, help="frame of the walk, counted from 0")
    parser.add_argument("--count", type=int, required=True, help="people on the contact sheet")
    arguments = parser.parse_args()
    human, walk = load_human(arguments.human), walk_and_wave(arguments.frames)
    with np.load(arguments.skinned) as skinned:
        pairs = zip(skinned["frames"], skinned["vertices"], strict=True)
        error = max(lbs_error_mm(human, walk[number - 1], vertices) for number, vertices in pairs)
    figures = {"lbs_error_mm_max": error, **march_pictures(human, walk[arguments.frame], arguments.out)}
    print("contact sheet", flush=True)
    figures["seconds_sample_draft"] = draw_sheet(arguments.count, arguments.out / "contact_sheet.png")
    arguments.json.write_text(json.dumps(figures), encoding="utf-8")


def lbs_error_mm(human: Human, rotation: np.ndarray, vertices: np.ndarray) -> float:
    """Largest distance in mm between vertices [V, 3] that Blender has skinned and the same ones skinned here."""
    shaped = default_body().to(dtype=torch.float64).shape(human.betas.double())
    posed = shaped.pose(BodyPose(torch.from_numpy(rotation), torch.zeros(3, dtype=torch.float64))).vertices.numpy()
    upright = np.stack([posed[:, 0], -posed[:, 2], posed[:, 1]], -1)  # y up to z up
    return float(np.linalg.norm(vertices - upright, axis=-1).max() * 1e3)


def share_on_body(position: torch.Tensor) -> float:
    """Share of the grid's cells with a distinct point on the body: on a face, 1 mm or more from all others."""
    distance = torch.cdist(position.double(), position.double())
    distance.fill_diagonal_(torch.inf)
    body, anchors = default_body(), default_anchors()
    on_a_face = (anchors.face >= 0) & (anchors.face < body.faces.shape[0]) & (anchors.barycentric >= -1e-6).all(-1)
    return float((on_a_face & (distance.amin(-1) >= 1e-3)).float().mean())


def march_pictures(human: Human, rotation: np.ndarray, out: Path) -> dict[str, float]:
    """Draw the human at rest and as posed."""
    rest = place(human, None)
    walking = place(human, BodyPose(torch.from_numpy(rotation).float(), torch.zeros(3)))
    front = framing(rest)
    march(rest, front)  # compiles, or loads the compiled code
    start = time.perf_counter()
    rendering = march(rest, front)
    seconds = time.perf_counter() - start

    rendering.save(out / "march_rest.png", BACKGROUND)
    depth_to_png(out / "march_depth.png", rendering.depth, rendering.alpha)
    march(walking, framing(walking)).save(out / "march_posed.png", BACKGROUND)
    march(walking, framing(walking, 70)).save(out / "march_side.png", BACKGROUND)
    boxes = draw(Scene(rest, chart=default_anchors().chart), front, ViewSettings("boxes"))
    rgba_to_png(out / "march_boxes.png", torch.from_numpy(boxes.rgba), BACKGROUND)
    return {"seconds_march_512": seconds, "grid_share_on_body": share_on_body(rest.position)}


def draw_sheet(count: int, path: Path) -> float:
    """Generate people of consecutive seeds and draw the sheet; returns the median seconds of one."""
    model, people, seconds = load_checkpoint(), [], []
    for seed in range(count):
        start = time.perf_counter()
        people.append(generate(model, seed, *DRAFT))
        seconds.append(time.perf_counter() - start)
    Image.fromarray(contact_sheet.sheet(people, count, SHEET_PX)).save(path)
    return float(np.median(seconds))


if __name__ == "__main__":
    main()
