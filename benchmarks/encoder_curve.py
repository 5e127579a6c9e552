"""Plots an encoder's training: PSNR on training people and held-out people by step, from a run's metrics.jsonl.

`python benchmarks/encoder_curve.py --metrics docs/results/encoder_metrics.jsonl --plot docs/pictures/encoder_curve.png`
plots it and prints the gain of the last doubling of the steps, an upper bound for the gain of another doubling.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot

SETS = {"psnr_train": "training people", "psnr_held": "people held out"}


def read_curve(path: Path) -> dict[str, list[tuple[int, float]]]:
    """Step and PSNR (dB) of each record, for both sets."""
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return {name: [(row["step"], row[name]) for row in rows if name in row] for name in SETS}


def last_doubling(curve: list[tuple[int, float]]) -> float:
    """Gain in dB from half of the steps to all of them."""
    half = min(curve, key=lambda point: abs(point[0] - curve[-1][0] / 2))
    return curve[-1][1] - half[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--metrics", type=Path, required=True, help="metrics.jsonl of a run")
    parser.add_argument("--plot", type=Path, help="PNG to write")
    arguments = parser.parse_args()
    curves = read_curve(arguments.metrics)
    for name, curve in curves.items():
        steps, psnr = curve[-1]
        print(f"{name}: {psnr:.2f} dB after {steps} steps, {last_doubling(curve):+.2f} in the last doubling")
    if arguments.plot is not None:
        figure, axes = pyplot.subplots(figsize=(7, 4), layout="constrained")
        for name, curve in curves.items():
            axes.plot(*zip(*curve, strict=True), label=SETS[name])
        axes.set(xlabel="steps", ylabel="PSNR, dB (whole images, 256 x 256)")
        axes.grid(alpha=0.3)
        axes.legend()
        figure.savefig(arguments.plot, dpi=120)


if __name__ == "__main__":
    main()
