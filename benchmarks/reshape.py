"""Measures how long moving a shape slider takes on a person of 1024 volumes.

`python benchmarks/reshape.py --json reshape.json`, or `--quick` with fewer moves. Milliseconds are medians of wall
time. reshape_ms: setting the betas, which moves bones, body mesh and volumes. reshape_evaluate_ms: Blender's work
before it can draw again, mostly rebuilding the dependency graph, as after every edit of bones. graph_ms: that rebuild
alone, triggered by linking an empty object.

`python benchmarks/reshape.py boxes --json F`, or `--quick` with small pictures, compares rules for the growth of boxes
on another body: reshaped people against people made for that body. The default body with a checkered
texture, bare or with a suit 2 cm off the skin, is filled into boxes at the mean body and reshaped to a heavy, a thin, a
tall and a short one; the reference is the same texture filled into boxes at that body. For each share of the stretch
(`primdiffusion.editing.reshaping.SHARE` is the default), in percent N: psnr_N of the pictures in dB, and holes_N, the
share of pixels opaque in the reference that are transparent (opacity below 0.7); means over bodies and suits.
Names with a body, such as psnr_heavy_50, are of that body.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import blender_isolated  # noqa: F401  before bpy
import bpy
import numpy as np
import torch
from march_people import checkered_human
from primdiffusion.body.model import betas_of_measures, default_body
from primdiffusion.editing import reshaping
from primdiffusion.evaluation.metrics import psnr
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.human import Human, framing, place
from primdiffusion.human_file import save_human
from primdiffusion.render.march import march
from record import command_line, report, run

from blender_primdiffusion.scene.human import parts_of

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from blender_primdiffusion.scene.build import build_human
from blender_primdiffusion.scene.edit import reshape
from blender_primdiffusion.scene.human_file import shape_model_of

MOVES, QUICK_MOVES = 30, 5
MEAN = torch.zeros(10)
MEASURES = {"heavy": (1.76, 110.0), "thin": (1.76, 45.0), "tall": (2.1, None), "short": (1.45, None)}
"""Height in metres and weight in kilograms."""
OFF_THE_SKIN = (0.0, 0.02)
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
GREY = (0.35, 0.35, 0.35)


def milliseconds(call: Callable[[], object]) -> float:
    began = time.perf_counter()
    call()
    return 1000 * (time.perf_counter() - began)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    folder = Path(tempfile.mkdtemp(prefix="reshape_", dir=bpy.app.tempdir))
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"))
    save_human(folder / "a.human", checkered_human(0))
    person = build_human(bpy.context, folder / "a.human")
    bpy.context.view_layer.update()
    model, rng = shape_model_of(person), np.random.default_rng(0)
    setting, evaluating, resting, linking = [], [], [], []
    for _ in range(QUICK_MOVES if given.quick else MOVES):
        betas = rng.normal(size=10)
        resting.append(milliseconds(lambda betas=betas: model.rest(betas)))
        setting.append(milliseconds(lambda betas=betas: reshape(person, betas)))
        evaluating.append(milliseconds(bpy.context.view_layer.update))
        bpy.context.scene.collection.objects.link(bpy.data.objects.new("Empty", None))
        linking.append(milliseconds(bpy.context.view_layer.update))
    figures = {
        "reshape_rest_ms": statistics.median(resting),
        "reshape_ms": statistics.median(setting),
        "reshape_evaluate_ms": statistics.median(evaluating),
        "graph_ms": statistics.median(linking),
        "reshape_volumes": sum(obj.type == "VOLUME" for obj in parts_of(person)),
    }
    report(figures, given.json)


def boxes() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--pictures", type=Path, help="folder for one picture per body")
    given = parser.parse_args()
    size = 128 if given.quick else 384
    figures: dict[str, float] = {}
    for name, measures in MEASURES.items():
        betas = betas_of_measures(MEAN, torch.eye(10), default_body(), *measures).float()
        seen = {share: [] for share in SHARES}
        for offset in OFF_THE_SKIN:
            before, truth = (checkered_human(0, b, offset) for b in (MEAN, betas))
            camera = framing(place(truth), 17, size, size)
            expected = march(place(truth), camera)
            for share in SHARES:
                drawn = march(place(grown(before, betas, share)), camera)
                holes = float((drawn.alpha[expected.alpha > 0.95] < 0.7).float().mean())
                colours = (encode_srgb(one.over(GREY).clamp(0, 1)) for one in (drawn, expected))
                seen[share].append((float(psnr(*colours)), holes))
                if given.pictures:
                    drawn.save(given.pictures / f"{name}_{offset:g}_{share:g}.png", GREY)
        for share, pairs in seen.items():
            for kind, values in zip(("psnr", "holes"), zip(*pairs, strict=True), strict=True):
                figures[f"{kind}_{name}_{100 * share:.0f}"] = statistics.mean(values)
    for share in SHARES:
        for kind in ("psnr", "holes"):
            of_bodies = [figures[f"{kind}_{name}_{100 * share:.0f}"] for name in MEASURES]
            figures[f"{kind}_{100 * share:.0f}"] = statistics.mean(of_bodies)
    report(figures, given.json)


def grown(human: Human, betas: torch.Tensor, share: float) -> Human:
    """The person reshaped with another share."""
    usual, reshaping.SHARE = reshaping.SHARE, share
    try:
        return reshaping.reshape_human(human, betas)
    finally:
        reshaping.SHARE = usual


if __name__ == "__main__":
    run(main, boxes=boxes)
