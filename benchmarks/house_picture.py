"""Draws the rooms of both programs and the imports between them from the source: docs/pictures/house.png.

    python benchmarks/house_picture.py --out docs/pictures/house.png

A room is drawn below all rooms that import it. Arrows implied by others are omitted: a room may import every room that
it can reach. Single files beside the rooms are omitted too.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import matplotlib as mpl
from house import ROOT, Module, parsed, sizes

mpl.use("Agg")
from matplotlib import pyplot
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

COLOURS = {"backend": "#3b6ea5", "extension": "#c46a1b"}
TITLES = {"backend": "backend/primdiffusion (torch)", "extension": "blender_primdiffusion (bpy)"}
BOX = (1.5, 0.62)
STEP = (1.75, 1.1)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "pictures" / "house.png")
    arguments = parser.parse_args()
    modules = parsed()
    figure, axes = pyplot.subplots(1, 2, figsize=(15, 9), gridspec_kw={"width_ratios": [8, 5]})
    for axis, program in zip(axes, ("backend", "extension"), strict=True):
        draw(axis, program, modules)
    figure.tight_layout()
    figure.savefig(arguments.out, dpi=90)
    print(arguments.out)


def draw(axis: pyplot.Axes, program: str, modules: list[Module]) -> None:
    """Draw rooms in layers, and an arrow from a room to each imported room unless a longer path leads there."""
    edges = room_imports(program, modules)
    layers = layers_of({room for edge in edges for room in edge}, set(edges))
    rows: dict[int, list[str]] = {}
    for room, layer in sorted(layers.items()):
        rows.setdefault(layer, []).append(room)
    places = {
        room: ((number - (len(rooms) - 1) / 2) * STEP[0], layer * STEP[1])
        for layer, rooms in rows.items()
        for number, room in enumerate(rooms)
    }
    figures = sizes(modules)
    for above, below in shortest(set(edges)):
        arrow = FancyArrowPatch(
            places[above], places[below], arrowstyle="-|>", mutation_scale=12, shrinkA=24, shrinkB=24,
            linewidth=1.2, color="#7d8790", zorder=1,
        )  # fmt: skip
        axis.add_patch(arrow)
    for room, (x, y) in places.items():
        corner = (x - BOX[0] / 2, y - BOX[1] / 2)
        style = "round,pad=0.02,rounding_size=0.08"
        axis.add_patch(FancyBboxPatch(corner, *BOX, boxstyle=style, color=COLOURS[program], zorder=2))
        axis.text(x, y + 0.1, room, ha="center", va="center", color="white", fontsize=11, weight="bold", zorder=3)
        files, lines = figures[f"{program}_{room}_files"], figures[f"{program}_{room}_lines"]
        axis.text(x, y - 0.16, f"{files} files, {lines} lines", ha="center", va="center", color="white", fontsize=7.5,
                  zorder=3)  # fmt: skip
    axis.set_title(TITLES[program], fontsize=13)
    axis.set_xlim(min(x for x, _ in places.values()) - 1, max(x for x, _ in places.values()) + 1)
    axis.set_ylim(-0.6, max(y for _, y in places.values()) + 0.6)
    axis.axis("off")


def room_imports(program: str, modules: list[Module]) -> Counter[tuple[str, str]]:
    """The number of imports from one room to another."""
    own = {module.name: module.room for module in modules if module.program == program}
    counts: Counter[tuple[str, str]] = Counter()
    for module in modules:
        if module.program != program or module.room == "top":
            continue
        for each in module.imports:
            for target in each.targets:
                room = own.get(target) or own.get(target.rpartition(".")[0])
                if room not in (None, module.room, "top"):
                    counts[module.room, str(room)] += 1
    return counts


def shortest(edges: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """The edges that are not implied by a longer path: the transitive reduction of an acyclic graph."""
    below: dict[str, set[str]] = {}
    for above, other in edges:
        below.setdefault(above, set()).add(other)

    def reachable(room: str) -> set[str]:
        return {found for other in below.get(room, set()) for found in {other, *reachable(other)}}

    return {(a, b) for a, b in edges if not any(b in reachable(other) for other in below[a] - {b})}


def layers_of(rooms: set[str], edges: set[tuple[str, str]]) -> dict[str, int]:
    """The length of the longest path down from each room; rooms without imports are at 0."""
    layers = dict.fromkeys(rooms, 0)
    for _ in rooms:  # each round settles one more layer
        for above, below in edges:
            layers[above] = max(layers[above], layers[below] + 1)
    return layers


if __name__ == "__main__":
    main()
