"""How often a generated human has the attribute that was asked for, as the judge's feature network reads it.

    python benchmarks/attribute_hits.py --assets DIR --reference DIR --json docs/results/attribute_hits.json

`attribute_hit_*` is the mean over the values of an attribute, each asked of --each humans. `attribute_read_*` is how
often the network reads the same attribute rightly on renders of held-out meshes: hits cannot be more certain than that.
Values are compared by the names that users ask for. --reference is that of diffusion.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from diffusion_sets import asked, placed, seeds_of
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.evaluation.attribute_network import AttributeNetwork, features_of
from primdiffusion.evaluation.gallery import COLOURINGS, made_gallery, mesh_sources
from primdiffusion.evaluation.generation import ReferenceSet, open_reference_set
from primdiffusion.people.assets import open_assets
from primdiffusion.people.wardrobe import words_of
from record import command_line, report
from torch import Tensor

ASKED = ("sex", "outfit", "hair", "hat", "pattern")
FIRST_SEED = 1000
REAL_SEED, HELD_SEED = 0, 10_000_000


def read(network: AttributeNetwork, features: Tensor, name: str) -> list[str]:
    """The network's answers, by the names that users ask for."""
    labels = [named({name: label}, name) for label in network.space.categories[name]]
    return [labels[number] for number in network.predict(features)[name].argmax(-1).tolist()]


def named(attributes: Mapping[str, Any], name: str) -> str:
    return words_of(attributes)[name]


def share(found: list[str], wanted: list[str]) -> float:
    return sum(a == b for a, b in zip(found, wanted, strict=True)) / len(wanted)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--assets", type=Path, required=True, help="MakeHuman's assets")
    parser.add_argument("--reference", type=Path, default=Path("runs/reference"), help="portraits and feature network")
    parser.add_argument("--meshes", type=int, default=300, help="geometries of the reference; half as many held out")
    parser.add_argument("--checkpoint", type=Path, help="model to measure; the default one if omitted")
    parser.add_argument("--each", type=int, default=6, help="humans of each value")
    arguments = parser.parse_args()
    assets = open_assets(arguments.assets)
    reference = open_reference_set(
        mesh_sources(assets, seeds_of(arguments.meshes, REAL_SEED), COLOURINGS),
        mesh_sources(assets, seeds_of(arguments.meshes // 2, HELD_SEED), COLOURINGS),
        arguments.reference,
    )
    model = load_checkpoint(arguments.checkpoint)
    figures: dict[str, float | int | str | None] = {"humans_of_each_value": arguments.each}
    for name in ASKED:
        figures[f"attribute_read_{name}"] = round(reading_accuracy(reference, name), 4)
        hits = []
        for number, value in enumerate(model.vocabulary.categories[name]):
            seeds = seeds_of(arguments.each, FIRST_SEED + arguments.each * number)
            made = made_gallery(placed(asked(model, seeds, {name: value})))
            hits.append(share(read(reference.network, features_of(reference.network, made), name), [value] * len(made)))
            print(name, value, hits[-1], flush=True)
        figures[f"attribute_hit_{name}"] = round(sum(hits) / len(hits), 4)
    figures["attribute_hit_min"] = min(figures[f"attribute_hit_{name}"] for name in ASKED)
    report(figures, arguments.json)


def reading_accuracy(reference: ReferenceSet, name: str) -> float:
    """Of the network, on renders of held-out meshes."""
    samples = reference.held.attributes
    return share(read(reference.network, reference.held_features, name), [named(one, name) for one in samples])


if __name__ == "__main__":
    main()
