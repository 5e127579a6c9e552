"""The marcher's scenes as a table and a plot."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

COLOURS = {"size": "#1b6ca8", "person": "#c8553d", "pose": "#6a994e", "boxes": "#7b2d8b", "people": "#222222"}


@dataclasses.dataclass(frozen=True)
class Row:
    """The cost of one picture; milliseconds are processor time of all threads together."""

    group: str
    name: str
    pixels: int
    boxes: int
    hit_share: float
    samples: int
    """Lattice points inside boxes on rays that are not yet opaque: the work of SPEC 4."""
    evaluated: int
    """The samples that were looked up; the others are where a box is empty."""
    milliseconds: float
    roofline_ms: float
    """The time of `samples` at the processor's measured ceiling."""


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """Write a markdown table with one row per picture."""
    lines = [
        "| varied | picture | boxes | hit rays | samples (M) | evaluated (M) | ms | ns per sample | x roofline |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row.group} | {row.name} | {row.boxes} | {row.hit_share:.1%} | {row.samples / 1e6:.2f} | "
            f"{row.evaluated / 1e6:.2f} | {row.milliseconds:.1f} | {1e6 * row.milliseconds / row.samples:.1f} | "
            f"{row.milliseconds / row.roofline_ms:.1f} |"
        )
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_plot(path: Path, rows: Sequence[Row]) -> None:
    """Plot time against samples, where all pictures lie on one line, and against boxes x pixels, where they do not."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4.4), sharey=True)
    for group, colour in COLOURS.items():
        members = [row for row in rows if row.group == group]
        times = [row.milliseconds for row in members]
        left.loglog([row.samples for row in members], times, "o", color=colour, label=group)
        right.loglog([row.boxes * row.pixels for row in members], times, "o", color=colour)
    ordered = sorted(rows, key=lambda row: row.samples)
    samples = [row.samples for row in ordered]
    left.loglog(samples, [row.roofline_ms for row in ordered], "k-", linewidth=1, label="roofline")
    left.loglog(samples, [8 * row.roofline_ms for row in ordered], "k--", linewidth=1, label="8 x roofline")
    left.set(xlabel="samples inside boxes", ylabel="processor time per picture, ms")
    right.set(xlabel="boxes x pixels")
    left.legend(fontsize=8)
    for axes in (left, right):
        axes.grid(True, which="both", linewidth=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
