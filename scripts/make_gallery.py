"""Generate the humans of the viewer's gallery as compact .human files:

    python scripts/make_gallery.py --out DIR Ada=7 "Ben=8,sex=male,height=1.9" [--steps 60] [--checkpoint FILE]

Each argument is a name and a seed, and attributes where wanted; `build_addon.py --viewer --gallery DIR` packs them.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.human import generate
from primdiffusion.human_file import save_human

STEPS = 60


class Wanted(NamedTuple):
    """A human to generate."""

    name: str
    seed: int
    attributes: dict[str, str | float]


def wanted(text: str) -> Wanted:
    """Parse NAME=SEED[,ATTRIBUTE=VALUE...]. Raises ValueError."""
    first, *others = text.split(",")
    name, _, seed = first.partition("=")
    if not name or not seed.isdecimal() or not all("=" in other for other in others):
        raise ValueError(f"{text!r} is not NAME=SEED[,ATTRIBUTE=VALUE...]")
    attributes: dict[str, str | float] = {}
    for other in others:
        attribute, _, value = other.partition("=")
        attributes[attribute] = float(value) if value.replace(".", "", 1).isdecimal() else value
    return Wanted(name, int(seed), attributes)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("humans", nargs="+", type=wanted, metavar="NAME=SEED[,ATTRIBUTE=VALUE...]")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--checkpoint", type=Path)
    given = parser.parse_args(arguments)
    model = load_checkpoint(given.checkpoint)
    given.out.mkdir(parents=True, exist_ok=True)
    for human in given.humans:
        path = given.out / f"{human.name.replace(' ', '_')}.human"
        save_human(path, generate(model, human.seed, given.steps, attributes=human.attributes), compact=True)
        print(f"{path}  {path.stat().st_size / 1e6:.1f} MB", flush=True)


if __name__ == "__main__":
    main()
