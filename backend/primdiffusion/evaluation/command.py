"""The command `primdiffusion evaluate`: how good trained models are."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import tyro
from tqdm import tqdm

from primdiffusion import __version__
from primdiffusion.evaluation.reconstruction import Reconstructor

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


def _write(path: Path, record: Mapping[str, Any]) -> None:
    from primdiffusion.staging import written_whole

    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as unfinished:
        unfinished.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def run(arguments: Sequence[str], load_encoder: LoadEncoder) -> None:
    """Parses and runs one line."""
    commands = {"reconstruction": EvaluateReconstruction}
    command = tyro.extras.subcommand_cli_from_dict(
        commands, prog="primdiffusion evaluate", description=DESCRIPTION, args=arguments or ["--help"]
    )
    command.run(load_encoder)
