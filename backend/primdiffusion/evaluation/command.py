"""The command `primdiffusion evaluate`: how good trained models are."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import tyro
from tqdm import tqdm

from primdiffusion import __version__
from primdiffusion.evaluation.reconstruction import Reconstructor

if TYPE_CHECKING:
    from primdiffusion.diffusion.model import DiffusionModel
    from primdiffusion.evaluation.gallery import ReadPerson

DESCRIPTION = "How good trained models are."


class TrainedReconstructor(Reconstructor, Protocol):
    """One from a checkpoint."""

    @property
    def card(self) -> Mapping[str, Any]:
        """What it is."""
        ...


LoadEncoder = Callable[[Path | None], TrainedReconstructor]
"""Reads a checkpoint, None: the package's own. Its caller gives it: evaluation imports nothing of training."""


@dataclasses.dataclass(frozen=True)
class EvaluateReconstruction:
    """Compare an encoder's people with captures of them: PSNR, SSIM, overlap of masks, LPIPS if weights are given.

    Everybody is encoded once, from some views of one pose, then drawn from all cameras in all poses.
    """

    captures: Path
    """Folder of captures."""
    checkpoint: Path | None = None
    """Trained encoder (.safetensors); without it the one that comes with the package."""
    people: int = 0
    """How many, in the order of their names; 0: all."""
    views: int = 8
    """How many cameras the encoder is given, spread around the person."""
    frame: int = 0
    """The pose in which."""
    size: int = 512
    """Pixels a side of the pictures that are compared."""
    lpips: tuple[Path, ...] = ()
    """LPIPS' weights: one file with all, or torchvision's of VGG16 or AlexNet and the linear weights."""
    json: Path | None = None
    """File for the means and every picture's scores."""

    def run(self, load_encoder: LoadEncoder) -> None:
        """Evaluates, and prints a table.

        Raises:
            ValueError, FileNotFoundError: captures, checkpoint or weights are missing, damaged or do not fit.
        """
        from primdiffusion.capture.reader import open_captures
        from primdiffusion.evaluation.image_metrics import load_lpips
        from primdiffusion.evaluation.reconstruction import EvaluationSettings, evaluate, summary, table

        if self.people < 0:
            raise ValueError(f"people is {self.people}: ask for one or more, or 0 for everybody")
        captures = open_captures(self.captures)
        names = captures.subjects[: self.people or None]
        settings = EvaluationSettings(names, given_views=self.views, given_frame=self.frame, size=self.size)
        lpips = load_lpips(self.lpips) if self.lpips else None
        model = load_encoder(self.checkpoint)
        scores = []
        with tqdm(total=len(names), unit="person", disable=None) as bar:
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
        print(table(means))


@dataclasses.dataclass(frozen=True)
class StageTwo:
    """What of training the evaluation of generated people needs; given by its caller, as `LoadEncoder` is."""

    load_model: Callable[[Path | None], DiffusionModel]
    """Reads a checkpoint, None: the package's own."""
    find_people: Callable[[Path], Sequence[Path]]
    split_people: Callable[[Sequence[Path], float, int], tuple[list[Path], list[Path]]]
    """By the share that is held out and a seed."""
    read_person: ReadPerson


@dataclasses.dataclass(frozen=True)
class EvaluateGeneration:
    """Compare generated people with people the model was not trained on, in a feature space of their attributes.

    Also tells whether they are copies: how far they are from training people, beside how far new people are.
    """

    people: Path
    """Folder of the payloads that the model was trained on, those held out among them."""
    judge: Path
    """Folder for portraits and feature network; what is not there is made, which takes minutes."""
    assets: Path | None = None
    """MakeHuman's assets, if the people were made from them: they are compared as renders of their meshes, so that what
    payloads lack counts too. Without it, as renders of their payloads."""
    checkpoint: Path | None = None
    """Model (.safetensors); without it the one that comes with the package."""
    count: int = 256
    """People to generate, of successive seeds."""
    first_seed: int = 0
    """The first of them."""
    steps: int = 30
    """Sampling steps."""
    holdout: float = 0.05
    """Share of people that was held out in training."""
    seed: int = 0
    """Seed of the training run."""
    json: Path | None = None
    """File for the figures."""

    def run(self, stage_two: StageTwo) -> None:
        """Evaluates, and prints a table.

        Raises:
            ValueError, FileNotFoundError: people or checkpoint are missing, damaged or too few.
        """
        from primdiffusion.evaluation.attribute_network import features_of
        from primdiffusion.evaluation.distances import NEIGHBOURS
        from primdiffusion.evaluation.gallery import COLOURINGS, made_gallery, mesh_sources, payload_sources, read_seed
        from primdiffusion.evaluation.generation import compare, open_reference_set, real_vs_real, table
        from primdiffusion.human import generate, place
        from primdiffusion.people.assets import open_assets

        if self.count <= NEIGHBOURS:
            raise ValueError(
                f"count is {self.count}: ask for more than {NEIGHBOURS} people, or nothing can be compared"
            )
        train, held = stage_two.split_people(stage_two.find_people(self.people), self.holdout, self.seed)
        model = stage_two.load_model(self.checkpoint)
        if self.assets is None:
            real = [payload_sources(paths, stage_two.read_person) for paths in (train, held)]
        else:
            assets = open_assets(self.assets)
            real = [mesh_sources(assets, [read_seed(path) for path in paths], COLOURINGS) for paths in (train, held)]
        with tqdm(unit="person", disable=None) as bar:

            def report(done: int, total: int) -> None:
                bar.update(1)

            reference = open_reference_set(*real, self.judge, report)
        with tqdm(range(self.first_seed, self.first_seed + self.count), unit="person", disable=None) as seeds:
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
                "feature_accuracy": reference.held_accuracies,
            }
            _write(self.json, record)
        print(table(rows))


def _write(path: Path, record: Mapping[str, Any]) -> None:
    from primdiffusion.staging import written_whole

    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as unfinished:
        unfinished.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def run(arguments: Sequence[str], load_encoder: LoadEncoder, stage_two: Callable[[], StageTwo] | None = None) -> None:
    """Parses and runs one line; without `stage_two` only reconstructions can be evaluated."""
    commands: dict[str, Any] = {"reconstruction": EvaluateReconstruction}
    if stage_two is not None:
        commands["generation"] = EvaluateGeneration
    command = tyro.extras.subcommand_cli_from_dict(
        commands, prog="primdiffusion evaluate", description=DESCRIPTION, args=arguments or ["--help"]
    )
    if stage_two is not None and isinstance(command, EvaluateGeneration):
        command.run(stage_two())
    else:
        command.run(load_encoder)
