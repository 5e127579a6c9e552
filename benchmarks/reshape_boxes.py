"""Compares rules for the growth of boxes on another body: reshaped people against people made for that body.

`python benchmarks/reshape_boxes.py --json F`, or `--quick` with small pictures. The default body with a checkered
texture, bare or with a suit 2 cm off the skin, is filled into boxes at the mean body and reshaped to a heavy, a thin, a
tall and a short one; the reference is the same texture filled into boxes at that body. For each share of the stretch
(`primdiffusion.reshaping.SHARE` is the default), in percent N: psnr_N of the pictures in dB, and holes_N, the share of
pixels opaque in the reference that are transparent (opacity below 0.7); means over bodies and suits.
Names with a body, such as psnr_heavy_50, are of that body.
"""

from __future__ import annotations

import statistics
from pathlib import Path

import march_people
import torch
from primdiffusion import reshaping
from primdiffusion.body.measures import betas_of_measures
from primdiffusion.body.model import default_body
from primdiffusion.evaluation.image_metrics import psnr
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.human import Human, framing, place
from primdiffusion.render.image import over, to_png
from primdiffusion.render.march import march
from record import command_line, report

MEAN = torch.zeros(10)
MEASURES = {"heavy": (1.76, 110.0), "thin": (1.76, 45.0), "tall": (2.1, None), "short": (1.45, None)}
"""Height in metres and weight in kilograms."""
OFF_THE_SKIN = (0.0, 0.02)
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
GREY = (0.35, 0.35, 0.35)


def main() -> None:
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
            before, truth = (march_people.checkered_human(0, b, offset) for b in (MEAN, betas))
            camera = framing(place(truth), 0.3, size, size)
            expected = march(place(truth), camera)
            for share in SHARES:
                drawn = march(place(grown(before, betas, share)), camera)
                holes = float((drawn.alpha[expected.alpha > 0.95] < 0.7).float().mean())
                colours = (encode_srgb(over(one, GREY).clamp(0, 1)) for one in (drawn, expected))
                seen[share].append((float(psnr(*colours)), holes))
                if given.pictures:
                    to_png(given.pictures / f"{name}_{offset:g}_{share:g}.png", drawn, GREY)
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
        return reshaping.reshaped(human, betas)
    finally:
        reshaping.SHARE = usual


if __name__ == "__main__":
    main()
