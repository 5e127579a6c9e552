"""Pictures of generated humans beside their nearest training samples, and beside baselines.

`python benchmarks/diffusion_pictures.py --people DIR --reference DIR --voxel voxel.safetensors --neighbours
docs/pictures/neighbours.png` renders humans from consecutive seeds, not hand-picked, each beside the nearest training
samples by features and by latents, with distances (1 is the median of the held-out set). --reference is the folder of
benchmarks/diffusion.py. `--comparison docs/pictures/generated_comparison.png --checkpoint ours/model.safetensors
--latents latents/model.safetensors --voxel voxels/voxel.safetensors` renders rows of held-out samples, and of the
models that benchmarks/tables.py compares.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from diffusion import epoch, progress
from diffusion_sets import generated, placed, seeds_of, voxels
from latent_baseline import sample_people
from neighbours import nearest_stored
from PIL import Image, ImageDraw, ImageFont
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.evaluation.attribute_network import features_of
from primdiffusion.evaluation.distances import nearest
from primdiffusion.evaluation.gallery import made_gallery, payload_of, payload_sources
from primdiffusion.evaluation.generation import ReferenceSet, open_reference_set
from primdiffusion.evaluation.portraits import PORTRAITS, Portrait, camera_of
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.human import place
from primdiffusion.people.payloads import rest_frames
from primdiffusion.primitives.primitives import Payload, Primitives
from primdiffusion.render.image import over
from primdiffusion.render.march import march
from primdiffusion.training.latents import split_people
from primdiffusion.training.stored_people import find_people, read_person
from torch import Tensor
from voxel_baseline import load_voxel_model

BACKGROUND = (0.72, 0.72, 0.72)
CELL = 192
HEADING, NAME, CAPTION = 26, 24, 20
"""Heights of the headings' row and of captions, width of the rows' names, pixels."""
INK, PAPER = (30, 30, 30), (221, 221, 221)
FRONT, BACK, HEAD = (next(p for p in PORTRAITS if p.name == name) for name in ("front", "back", "head"))
MARGIN = 0.09
"""Share of the front view's width that is cut off at each side."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=Path, required=True, help="folder of the payloads that were trained on")
    parser.add_argument("--holdout", type=float, default=0.08)
    parser.add_argument("--seed", type=int, default=0, help="of the training run")
    parser.add_argument("--reference", type=Path, default=Path("runs/reference"))
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--latents", type=Path, help="baseline of diffusion_primitives.py")
    parser.add_argument("--voxel", type=Path, help="baseline of diffusion_voxel.py")
    parser.add_argument("--count", type=int, default=8, help="people in a picture")
    parser.add_argument("--neighbours", type=Path, help="PNG of people beside their neighbours")
    parser.add_argument("--comparison", type=Path, help="PNG of people beside baselines'")
    arguments = parser.parse_args()
    model = load_checkpoint(arguments.checkpoint)
    train, held = split_people(find_people(arguments.people), arguments.holdout, arguments.seed)
    if arguments.neighbours is not None:
        reference = open_reference_set(
            payload_sources(train, read_person),
            payload_sources(held, read_person),
            arguments.reference,
            progress("portraits"),
            epoch,
        )
        neighbours(reference, model, train, held, arguments.count).save(arguments.neighbours, optimize=True)
        print(arguments.neighbours)
    if arguments.comparison is not None:
        comparison(model, held, arguments.latents, arguments.voxel, arguments.count).save(
            arguments.comparison, optimize=True
        )
        print(arguments.comparison)


def neighbours(
    reference: ReferenceSet, model: DiffusionModel, train: Sequence[Path], held: Sequence[Path], count: int
) -> Image.Image:
    """A column a seed: the person, the nearest by features and the nearest by latents."""

    def encode(payload: Payload) -> Tensor:
        return model.encode(payload)

    people = list(generated(model, seeds_of(count)))
    primitives = [place(human) for human in people]
    by_features = nearest(features_of(reference.network, made_gallery(primitives)), reference.train_features)
    new = nearest(reference.held_features, reference.train_features).distance.median()
    references = [payload_of(read_person(path), 0) for path in held[:: max(len(held) // 32, 1)]]
    queries = torch.stack([encode(payload).flatten() for payload in (*(h.payload for h in people), *references)])
    by_latents = nearest_stored(queries, train, read_person, encode, progress("latents"))
    new_latents = by_latents.distance[count:].median()
    rows: list[tuple[str, list[tuple[Primitives, str]]]] = [
        ("generated", [(one, f"seed {seed}") for seed, one in zip(seeds_of(count), primitives, strict=True)]),
        ("nearest by features", []),
        ("nearest by latents", []),
    ]
    for number in range(count):
        row = int(by_features.index[number])
        geometry = int(reference.train.geometry[row])
        colouring = row - int((reference.train.geometry < geometry).sum())
        rows[1][1].append((stored(train[geometry], colouring), f"{float(by_features.distance[number] / new):.2f}"))
        path, colouring = train[int(by_latents.file[number])], int(by_latents.colouring[number])
        rows[2][1].append((stored(path, colouring), f"{float(by_latents.distance[number] / new_latents):.2f}"))
    return sheet(rows, "Distances in units of the median held-out person's: 1 is as new as new people are")


def stored(path: Path, colouring: int) -> Primitives:
    person = read_person(path)
    return Primitives.place(rest_frames(person.betas.numpy()), payload_of(person, colouring))


def comparison(
    model: DiffusionModel, held: Sequence[Path], latents: Path | None, voxel: Path | None, count: int
) -> Image.Image:
    """A row for each way to make people."""
    seeds = seeds_of(count)
    some = held[:: max(len(held) // count, 1)][:count]
    sets: dict[str, Iterable[Primitives]] = {
        "held out": (stored(path, 0) for path in some),
        "ours": placed(generated(model, seeds)),
    }
    if latents is not None:
        sets["latents"] = placed(iter(sample_people(load_checkpoint(latents), seeds)))
    if voxel is not None:
        sets["voxels"] = voxels(load_voxel_model(voxel), seeds)
    rows = [(name, [(one, "") for one in islice(made, count)]) for name, made in sets.items()]
    return sheet(rows, "In T pose, from the front, and heads; consecutive seeds, evenly spaced held-out samples")


def sheet(rows: Sequence[tuple[str, Sequence[tuple[Primitives, str]]]], heading: str) -> Image.Image:
    """Rows of whole people over their heads, with captions."""
    columns = max(len(row) for _, row in rows)
    whole, below = round(CELL * (1 - 2 * MARGIN)), CELL // 2
    width, height = whole + below, CELL + CAPTION
    page = Image.new("RGB", (NAME + columns * width, HEADING + len(rows) * height), PAPER)
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(14)
    pen.text((page.width / 2, HEADING / 2), heading, INK, font, anchor="mm")
    for row, (name, people) in enumerate(rows):
        top = HEADING + row * height
        label = Image.new("RGB", (height, NAME), PAPER)
        ImageDraw.Draw(label).text((height / 2, NAME / 2), name, INK, font, anchor="mm")
        page.paste(label.rotate(90, expand=True), (0, top))
        for column, (primitives, caption) in enumerate(people):
            left = NAME + column * width
            page.paste(Image.fromarray(person(primitives)), (left, top))
            pen.text((left + width / 2, top + CELL + CAPTION / 2), caption, INK, font, anchor="mm")
    return page


def person(primitives: Primitives) -> np.ndarray:
    """From the front, beside the head over the back view."""
    front, back, head = (seen(primitives, portrait, size) for portrait, size in ((FRONT, 0), (BACK, 1), (HEAD, 1)))
    cut = round(CELL * MARGIN)
    return np.concatenate([front[:, cut : CELL - cut], np.concatenate([head, back], 0)], 1)


def seen(primitives: Primitives, portrait: Portrait, halvings: int) -> np.ndarray:
    """sRGB bytes of a portrait."""
    view = march(primitives, camera_of(portrait, CELL >> halvings))
    return (encode_srgb(over(view, BACKGROUND)).clamp(0, 1) * 255).round().to(torch.uint8).numpy()


if __name__ == "__main__":
    main()
