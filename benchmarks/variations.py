"""What choosing from many people costs, and looking at one while it is made, with the default checkpoint.

`python benchmarks/variations.py --json F` times the jobs of the child without the child: `generate` with and without
pictures while it samples, taken in turn, and `variations` of several numbers of people. `--out F.png` keeps the contact
sheet of 8 people. `--quick` takes few steps and each once.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from PIL import Image
from primdiffusion.commands.generate import GenerateRequest, VariationsRequest
from primdiffusion.commands.session import Session
from record import tell

PICTURE_PX = 256
DRAFT = {"steps": 8, "sampler": "dpmpp_2m"}
"""Of the extension's quality Draft."""
COLUMNS = 4
GROUND = (48, 48, 48)
"""Of a panel in Blender's dark theme."""


class Counter:
    """Takes reports and counts pictures."""

    def __init__(self) -> None:
        self.pictures = 0

    def __call__(self, *_: object, **more: Any) -> None:
        self.pictures += "picture" in more


def timed_generate(session: Session, folder: Path, steps: int, repeats: int) -> dict[str, float | int]:
    """Seconds of sampling with and without pictures, medians; how many pictures there were."""
    seconds: dict[int, list[float]] = {0: [], PICTURE_PX: []}
    counter = Counter()
    for seed in range(repeats):
        for px, taken in seconds.items():
            request = GenerateRequest(seed=seed, out_dir=folder / "person", steps=steps, size=16, picture_px=px)
            taken.append(request.run(session, counter)["seconds_sampling"])
    without, with_pictures = (statistics.median(taken) for taken in seconds.values())
    return {
        "generate_seconds": round(without, 3),
        "generate_with_pictures_seconds": round(with_pictures, 3),
        "pictures_overhead": round(with_pictures / without - 1, 3),
        "pictures_each": round(counter.pictures / repeats, 1),
    }


def timed_variations(session: Session, folder: Path, count: int, **how: Any) -> float:
    """Seconds until all are written."""
    began = time.perf_counter()
    VariationsRequest(seeds=list(range(7, 7 + count)), out_dir=folder, **how).run(session, Counter())
    return round(time.perf_counter() - began, 3)


def contact_sheet(folder: Path, out: Path) -> None:
    """The pictures of a folder of variations, by seed."""
    paths = sorted(folder.glob("*.png"), key=lambda path: int(path.stem))
    sheet = Image.new("RGB", (COLUMNS * PICTURE_PX, -(-len(paths) // COLUMNS) * PICTURE_PX), GROUND)
    for index, path in enumerate(paths):
        with Image.open(path) as picture:
            sheet.paste(picture, (index % COLUMNS * PICTURE_PX, index // COLUMNS * PICTURE_PX), picture)
    out.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(out)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--out", type=Path, help="PNG of the contact sheet of 8 people")
    parser.add_argument("--quick", action="store_true")
    asked = parser.parse_args()
    steps, repeats = (6, 1) if asked.quick else (30, 5)
    session, figures = Session(), {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        GenerateRequest(seed=0, out_dir=folder / "warm", steps=2, size=64).run(session, Counter())
        figures |= timed_generate(session, folder, steps, repeats)
        for count in (4, 8, 16):
            figures[f"variations_{count}_seconds"] = timed_variations(session, folder / str(count), count, steps=steps)
        figures["variations_8_draft_seconds"] = timed_variations(session, folder / "draft", 8, **DRAFT)
        person = folder / "8" / "7.human.safetensors"
        figures["variants_8_seconds"] = timed_variations(
            session, folder / "variants", 8, steps=steps, person=str(person)
        )
        if asked.out is not None:
            contact_sheet(folder / "8", asked.out)
    tell(figures, asked.json)


if __name__ == "__main__":
    main()
