"""The command `primdiffusion evaluate`: quality of trained models."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from tqdm import tqdm

from primdiffusion.capture.reader import open_captures
from primdiffusion.commands.evaluate_tables import Generated, TableOptions, measure
from primdiffusion.device import best_device
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.encoder.model import load_encoder
from primdiffusion.evaluation import generation, reconstruction
from primdiffusion.evaluation.attribute_network import features_of
from primdiffusion.evaluation.distances import NEIGHBOURS, too_few_samples
from primdiffusion.evaluation.gallery import (
    COLOURINGS,
    Source,
    made_gallery,
    mesh_sources,
    payload_sources,
    read_seed,
)
from primdiffusion.evaluation.generation import compare, open_reference_set, real_vs_real
from primdiffusion.evaluation.image_metrics import load_lpips
from primdiffusion.evaluation.reconstruction import EvaluationSettings, evaluate, summary
from primdiffusion.formats.requests import Count, Sampling
from primdiffusion.formats.schema import Range, check
from primdiffusion.formats.whole_files import write_atomically
from primdiffusion.human import generate, place
from primdiffusion.people.assets import open_assets
from primdiffusion.training.latents import split_people
from primdiffusion.training.stored_people import find_people, read_person
from primdiffusion.version import __version__

DESCRIPTION = "Measure the quality of trained models."


@dataclasses.dataclass(frozen=True)
class EvaluateReconstruction:
    """Compare encoded humans with their captures: PSNR, SSIM, mask overlap, and LPIPS if weights are given.

    Each human is encoded once, from some views of one pose, and rendered from all cameras in all poses.
    """

    captures: Path
    """Folder of captures."""
    checkpoint: Path | None = None
    """Trained encoder (.safetensors); the default one if omitted."""
    people: Annotated[int, Range(0)] = 0
    """Number of humans, in the order of their names; 0: all."""
    views: int = 8
    """Number of cameras given to the encoder, spread around the human."""
    frame: int = 0
    """Index of the pose that these views show."""
    size: int = 512
    """Pixels a side of the pictures that are compared."""
    lpips: tuple[Path, ...] = ()
    """LPIPS' weights: one file with all, or torchvision's of VGG16 or AlexNet and the linear weights."""
    json: Path | None = None
    """File for the means and every picture's scores."""

    def run(self) -> None:
        """Evaluate, and print a table.

        Raises:
            ValueError, FileNotFoundError: captures, checkpoint or weights are missing, damaged or do not fit.
        """
        check(self)
        captures = open_captures(self.captures)
        names = captures.subjects[: self.people or None]
        settings = EvaluationSettings(names, given_views=self.views, given_frame=self.frame, size=self.size)
        lpips = load_lpips(self.lpips) if self.lpips else None
        model = load_encoder(self.checkpoint, best_device())
        scores = []
        with tqdm(total=len(names), unit="human", disable=None) as bar:
            for score in evaluate(model, captures, settings, lpips):
                bar.update(len({*names[: bar.n], score.subject}) - bar.n)
                scores.append(score)
        means = summary(scores)
        if self.json is not None:
            record = {
                "version": __version__,
                "checkpoint": dict(model.card),
                "settings": dataclasses.asdict(settings),
                "means": {name: dataclasses.asdict(part) for name, part in means.items()},
                "pictures": [dataclasses.asdict(score) for score in scores],
            }
            _write(self.json, record)
        print(reconstruction.table(means))


@dataclasses.dataclass(frozen=True)
class EvaluateGeneration:
    """Compare generated humans with ones held out from training, in a feature space of human attributes.

    Also reports whether they are copies: their distance to the training set, relative to that of held-out humans. With
    --table, measure what the paper's tables have instead.
    """

    people: Path | None = None
    """Folder of the payloads that the model was trained on, those held out among them."""
    reference: Path | None = None
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
    tables: tyro.conf.OmitArgPrefixes[TableOptions] = dataclasses.field(default_factory=TableOptions)

    def run(self) -> None:
        """Evaluate, and print a table.

        Raises:
            ValueError, FileNotFoundError: people or checkpoint are missing, damaged or too few.
        """
        check(self)
        if self.tables.table is not None:
            generated = Generated(self.checkpoint, self.first_seed, self.count, self.steps)
            record, text = measure(self.tables, generated, self.assets)
            if self.json is not None:
                _write(self.json, record)
            print(text)
            return
        if self.people is None or self.reference is None:
            raise ValueError("give --people and --reference, or --table 1 or 2 for the paper's tables")
        if self.count <= NEIGHBOURS:
            raise ValueError(
                f"count is {self.count}: ask for more than {NEIGHBOURS} humans, or nothing can be compared"
            )
        real = real_sources(self.people, self.assets, self.holdout, self.seed)
        model = load_checkpoint(self.checkpoint, best_device())
        with tqdm(unit="human", disable=None) as bar:

            def report(done: int, total: int) -> None:
                bar.update(1)

            reference = open_reference_set(*real, self.reference, report)
        with tqdm(range(self.first_seed, self.first_seed + self.count), unit="human", disable=None) as seeds:
            made = made_gallery(place(generate(model, seed, self.steps)) for seed in seeds)
        rows = {
            "generated": compare(reference, features_of(reference.network, made)),
            "trained on": real_vs_real(reference, self.count),
        }
        if self.json is not None:
            record = {
                "version": __version__,
                "checkpoint": dict(model.card),
                "people": {name: dataclasses.asdict(row) for name, row in rows.items()},
                "feature_accuracy": reference.network.card.get("accuracy", {}),
            }
            _write(self.json, record)
        print(generation.table(rows))
        note = too_few_samples(self.count, *reference.held_features.shape)
        if note is not None:
            print(f"\nFrechet distance: {note}.")


def real_sources(people: Path, assets: Path | None, holdout: float, seed: int) -> tuple[list[Source], list[Source]]:
    """Portraits of the people that a model was trained on, and of those held out: of payloads, or of `assets`' meshes.

    Raises ValueError and FileNotFoundError for people or assets that are missing or unreadable.
    """
    split = split_people(find_people(people), holdout, seed)
    if assets is None:
        train, held = (payload_sources(paths, read_person) for paths in split)
        return train, held
    opened = open_assets(assets)
    train, held = (mesh_sources(opened, [read_seed(path) for path in paths], COLOURINGS) for paths in split)
    return train, held


def _write(path: Path, record: Mapping[str, Any]) -> None:
    write_atomically(path, json.dumps(record, indent=1) + "\n")


def run(arguments: Sequence[str]) -> None:
    """Run a command line; raises its errors."""
    commands: dict[str, Any] = {"reconstruction": EvaluateReconstruction, "generation": EvaluateGeneration}
    tyro.extras.subcommand_cli_from_dict(
        commands, prog="primdiffusion evaluate", description=DESCRIPTION, args=arguments or ["--help"]
    ).run()
