"""How often a generated human has the attribute that was asked for, as a network reads it.

    python benchmarks/attribute_hits.py --assets DIR --reference DIR --json docs/results/attribute_hits.json

`attribute_hit_*` is the mean over the values of an attribute, each asked of --each humans. `attribute_read_*` is how
often the network reads the same attribute rightly on renders of held-out meshes: hits cannot be more certain than that.
Values are compared by the names that users ask for. The network is that of the feature space, trained longer, on the
--reference portraits of diffusion.py at half their size, sharp and blurred, because only attributes matter here.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from diffusion_sets import asked, placed, seeds_of
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.evaluation.attribute_network import (
    AttributeNetwork,
    features_of,
    fit_attribute_network,
    load_attribute_network,
    save_attribute_network,
)
from primdiffusion.evaluation.gallery import COLOURINGS, Gallery, made_gallery, mesh_sources, open_gallery
from primdiffusion.evaluation.generation import PORTRAITS_FOLDER
from primdiffusion.people.assets import open_assets
from primdiffusion.people.wardrobe import words_of
from record import command_line, report
from torch import Tensor
from torch.nn import functional

ASKED = ("sex", "outfit", "hair", "hat", "pattern")
FIRST_SEED = 1000
REAL_SEED, HELD_SEED = 0, 10_000_000
EPOCHS = 40
NETWORK = "attribute_reader.safetensors"


def read(network: AttributeNetwork, features: Tensor, name: str) -> list[str]:
    """The network's answers, by the names that users ask for."""
    labels = [named({name: label}, name) for label in network.space.categories[name]]
    return [labels[number] for number in network.predict(features)[name].argmax(-1).tolist()]


def named(attributes: Mapping[str, Any], name: str) -> str:
    return words_of(attributes)[name]


def share(found: list[str], wanted: list[str]) -> float:
    return sum(a == b for a, b in zip(found, wanted, strict=True)) / len(wanted)


def halved(pictures: Tensor, blurred: bool = False) -> Tensor:
    """Portraits [n, v, h, w, 4] (bytes) averaged down to half their size."""
    small = functional.avg_pool2d(pictures.flatten(0, 1).movedim(-1, 1).float(), 2)
    if blurred:
        small = functional.avg_pool2d(small, 3, 1, 1, count_include_pad=False)
    return small.round().to(pictures.dtype).movedim(1, -1).unflatten(0, pictures.shape[:2])


def trained(gallery: Gallery, path: Path) -> AttributeNetwork:
    """The network at `path`, trained first if there is none."""
    if not path.is_file():
        pictures = torch.cat([halved(gallery.pictures, blurred) for blurred in (False, True)])
        attributes = [*gallery.attributes, *gallery.attributes]
        network = fit_attribute_network(pictures, attributes, epochs=EPOCHS, report=lambda *done: print(*done))
        save_attribute_network(path, network)
    return load_attribute_network(path)


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--assets", type=Path, required=True, help="MakeHuman's assets")
    parser.add_argument("--reference", type=Path, default=Path("runs/reference"), help="folder for portraits, network")
    parser.add_argument("--meshes", type=int, default=300, help="geometries to train on; half as many held out")
    parser.add_argument("--checkpoint", type=Path, help="model to measure; the default one if omitted")
    parser.add_argument("--each", type=int, default=6, help="humans of each value")
    arguments = parser.parse_args()
    assets = open_assets(arguments.assets)
    real, held = (
        open_gallery(mesh_sources(assets, seeds_of(count, seed), COLOURINGS), arguments.reference / PORTRAITS_FOLDER)
        for count, seed in ((arguments.meshes, REAL_SEED), (arguments.meshes // 2, HELD_SEED))
    )
    network = trained(real, arguments.reference / NETWORK)
    features = features_of(network, halved(held.pictures))
    model = load_checkpoint(arguments.checkpoint)
    figures: dict[str, float | int | str | None] = {"humans_of_each_value": arguments.each}
    for name in ASKED:
        true = [named(one, name) for one in held.attributes]
        figures[f"attribute_read_{name}"] = round(share(read(network, features, name), true), 4)
        print(name, figures[f"attribute_read_{name}"], flush=True)
    for name in ASKED:
        hits = []
        for number, value in enumerate(model.vocabulary.categories[name]):
            seeds = seeds_of(arguments.each, FIRST_SEED + arguments.each * number)
            made = halved(made_gallery(placed(asked(model, seeds, {name: value}))))
            hits.append(share(read(network, features_of(network, made), name), [value] * len(made)))
            print(name, value, hits[-1], flush=True)
        figures[f"attribute_hit_{name}"] = round(sum(hits) / len(hits), 4)
    figures["attribute_hit_min"] = min(figures[f"attribute_hit_{name}"] for name in ASKED)
    report(figures, arguments.json)


if __name__ == "__main__":
    main()
