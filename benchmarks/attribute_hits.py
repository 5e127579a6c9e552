"""How often a generated human has the attribute that was asked for, as a linear reader finds it in the latents.

    python benchmarks/attribute_hits.py --people DIR --json docs/results/attribute_hits.json

The reader is ridge regression from the latents of stored humans to each attribute's values, all of the same weight.
`attribute_read_*` is the share of held-out humans whose attribute it reads rightly (ten folds of geometries), the mean
over values: hits cannot be more certain than that. `attribute_hit_*` is that share of humans generated with one
attribute asked for, --each of every value; null where less than `READABLE` of stored humans are read rightly.
`attribute_worst_*` names the value with the fewest hits.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from diffusion_sets import asked, seeds_of
from jaxtyping import Float, Int
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.codec import CellCodec
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.people.stored_people import PersonFolder
from primdiffusion.training.latents import encode_people
from record import command_line, report
from torch import Tensor
from torch.nn import functional

ASKED = ("sex", "outfit", "hair", "hat", "pattern")
FIRST_SEED = 1000
READABLE = 0.95
FOLDS = 10
PENALTY = 0.1
"""Of ridge regression, in mean squared lengths of a latent."""


class Stored(NamedTuple):
    """Latents of stored humans about their mean, and their attributes."""

    mean: Float[Tensor, "d"]
    latents: Float[Tensor, "n d"]
    products: Float[Tensor, "n n"]
    """Of every two latents, with a constant for the intercept."""
    constant: Float[Tensor, ""]
    geometry: Int[Tensor, "n"]
    condition: Float[Tensor, "n a"]

    def products_with(self, latents: Float[Tensor, "m d"]) -> Float[Tensor, "m n"]:
        return (latents - self.mean) @ self.latents.T + self.constant


def read_stored(folder: Path, codec: CellCodec, vocabulary: AttributeVocabulary) -> Stored:
    people = PersonFolder(folder)
    found = encode_people(people, range(len(people.names)), codec.codec, vocabulary)
    latents = found.latents.flatten(1).float()
    mean = latents.mean(0)
    latents -= mean
    products = latents @ latents.T
    constant = products.diagonal().mean()
    return Stored(mean, latents, products + constant, constant, found.geometry, found.condition)


def ridge(products: Float[Tensor, "n n"], labels: Int[Tensor, "n"], count: int) -> Float[Tensor, "n v"]:
    """Weights of each stored human: the score of a value is the products with them times these."""
    one_hot = functional.one_hot(labels, count).float()
    alike = (len(labels) / count / one_hot.sum(0).clamp_min(1))[labels, None].sqrt()
    penalty = PENALTY * products.diagonal().mean() * torch.eye(len(labels))
    return alike * torch.linalg.solve(alike * products * alike.T + penalty, alike * (one_hot - 1 / count))


def read_held_out(stored: Stored, labels: Int[Tensor, "n"], count: int) -> Int[Tensor, "n"]:
    """Labels of each human by a reader that learned from the geometries of the other folds."""
    found = torch.empty_like(labels)
    for fold in range(FOLDS):
        held = stored.geometry % FOLDS == fold
        rows = stored.products[:, ~held]
        found[held] = (rows[held] @ ridge(rows[~held], labels[~held], count)).argmax(-1)
    return found


def mean_over_values(right: Tensor, labels: Int[Tensor, "n"]) -> float:
    return torch.stack([right[labels == value].float().mean() for value in labels.unique()]).mean().item()


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--people", type=Path, required=True, help="folder of fitted payloads")
    parser.add_argument("--checkpoint", type=Path, help="model to measure; the default one if omitted")
    parser.add_argument("--each", type=int, default=6, help="humans of each value")
    arguments = parser.parse_args()
    model = load_checkpoint(arguments.checkpoint)
    if not isinstance(model.codec, CellCodec):
        parser.error("the checkpoint has no latents of boxes: choose one of the default architecture")
    stored = read_stored(arguments.people, model.codec, model.vocabulary)
    figures: dict[str, float | int | str | None] = {
        "stored_geometries": int(stored.geometry.max()) + 1,
        "humans_of_each_value": arguments.each,
    }
    blocks = model.vocabulary.blocks()
    for name in ASKED:
        values = model.vocabulary.categories[name]
        labels = stored.condition[:, blocks[name]][:, : len(values)].argmax(-1)
        reads = mean_over_values(read_held_out(stored, labels, len(values)) == labels, labels)
        figures |= {f"attribute_read_{name}": round(reads, 4), f"attribute_hit_{name}": None}
        if reads < READABLE:
            continue
        weights = ridge(stored.products, labels, len(values))
        hits = {}
        for number, value in enumerate(values):
            seeds = seeds_of(arguments.each, FIRST_SEED + arguments.each * number)
            made = torch.stack([model.encode(human.payload).flatten() for human in asked(model, seeds, {name: value})])
            hits[value] = (stored.products_with(made) @ weights).argmax(-1).eq(number).float().mean().item()
            print(name, value, hits[value], flush=True)
        figures[f"attribute_hit_{name}"] = round(sum(hits.values()) / len(hits), 4)
        worst = min(hits, key=lambda value: hits[value])
        figures[f"attribute_worst_{name}"] = f"{worst}: {hits[worst]:.2f}"
    found = [value for key, value in figures.items() if key.startswith("attribute_hit_") and isinstance(value, float)]
    figures["attribute_hit_min"] = min(found) if found else None
    report(figures, arguments.json)


if __name__ == "__main__":
    main()
