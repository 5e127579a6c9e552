"""Compare generated humans with ones held out from training, in a feature space of human attributes.

    python -m scripts.train_attribute_network --reference DIR --people DIR [--assets DIR]      # once
    python -m scripts.feature_space --reference DIR --people DIR [--assets DIR] [--checkpoint FILE]

Also reports whether they are copies: their distance to the training set, relative to that of held-out humans.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import tyro
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.evaluation.metrics import too_few_samples
from primdiffusion.formats.requests import Count, Sampling
from primdiffusion.formats.schema import check
from primdiffusion.human import generate, place
from primdiffusion.runtime.device import best_device
from primdiffusion.version import __version__
from tqdm import tqdm

from scripts.feature_space.comparison import (
    NEIGHBOURS,
    compare,
    open_reference_set,
    real_sources,
    real_vs_real,
    table,
)
from scripts.feature_space.network import features_of
from scripts.feature_space.portraits import made_gallery


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Compare generated humans with ones held out from training, in a feature space of human attributes."""

    people: Path
    """Folder of the payloads that the model was trained on, those held out among them."""
    reference: Path
    """Folder of the feature network that scripts/train_attribute_network.py trains; portraits are kept there."""
    assets: Path | None = None
    """MakeHuman's assets, if the training set was made from them: the reference is then renders of the meshes, so that
    detail which payloads lack counts too. Without them it is renders of the payloads."""
    checkpoint: Path | None = None
    """Model (.safetensors); the default one if omitted."""
    count: Count = 256
    """Number of humans to generate, from successive seeds."""
    first_seed: int = 0
    """The first seed."""
    steps: int = Sampling.steps
    """Sampling steps."""
    holdout: float = 0.05
    """Share that was held out in training."""
    seed: int = 0
    """Seed of the training run."""
    json: Path | None = None
    """File for the figures."""


def main(options: Options) -> None:
    """Compare, and print a table. Raises ValueError and FileNotFoundError for what is missing, damaged or too few."""
    check(options)
    if options.count <= NEIGHBOURS:
        raise ValueError(f"count is {options.count}: ask for more than {NEIGHBOURS} humans, or nothing can be compared")
    real = real_sources(options.people, options.assets, options.holdout, options.seed)
    model = load_checkpoint(options.checkpoint, best_device())
    with tqdm(unit="human", disable=None) as bar:
        reference = open_reference_set(*real, options.reference, lambda done, total: bar.update(1))
    with tqdm(range(options.first_seed, options.first_seed + options.count), unit="human", disable=None) as seeds:
        made = made_gallery(place(generate(model, seed, options.steps)) for seed in seeds)
    rows = {
        "generated": compare(reference, features_of(reference.network, made)),
        "trained on": real_vs_real(reference, options.count),
    }
    if options.json is not None:
        record = {
            "version": __version__,
            "checkpoint": dict(model.card),
            "people": {name: dataclasses.asdict(row) for name, row in rows.items()},
            "feature_accuracy": reference.network.card.get("accuracy", {}),
        }
        options.json.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(table(rows))
    note = too_few_samples(options.count, *reference.held_features.shape)
    if note is not None:
        print(f"\nFrechet distance: {note}.")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
