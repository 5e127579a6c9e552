"""Samples of stage 1: what the encoder reads of a person, and pictures that the result is compared with."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from primdiffusion.capture.conditioning import default_betas
from primdiffusion.capture.dataset import CaptureDataset, Position, SampleSet, SampleSettings, Share, Views, batches
from primdiffusion.capture.reader import Captures
from primdiffusion.encoder.config import PRESETS, EncoderConfig
from primdiffusion.encoder.model import frames_of, look_up
from primdiffusion.encoder.network import motion_of
from primdiffusion.encoder.unproject import Unprojected
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import Frames
from primdiffusion.training.fit_config import FitConfig

CAUGHT = "Caught "
"""How torch's loader begins what a worker raised; the worker's traceback follows."""


@dataclasses.dataclass(frozen=True)
class FitSample(TensorRecord):
    """One person, or a batch of such."""

    found: Unprojected
    """What was looked up in the pictures that the encoder is given."""
    axis_angle: Float[Tensor, "*b 24 3"]
    """The pose in these."""
    frames: Frames
    """Of the boxes in the targets' pose, before delta scales."""
    target: Views
    subject: Int64[Tensor, "*b"]
    frame: Int64[Tensor, "*b"]
    """Of the targets."""


Batch = tuple[FitSample, Position]
"""Samples, and the place behind them."""


class FitDataset(SampleSet[FitSample]):
    """`CaptureDataset`'s samples, unprojected where they are read: in the loader's workers."""

    def __init__(self, samples: CaptureDataset, encoder: EncoderConfig) -> None:
        """Raises what `betas_of` does, for everybody: before training begins and not within it."""
        self.samples, self.encoder = samples, encoder
        self.betas = betas_of(samples.captures)

    def __len__(self) -> int:
        """Samples of an epoch."""
        return len(self.samples)

    def __getitem__(self, position: tuple[int, int]) -> FitSample:
        """The sample at a position. Raises what `CaptureDataset` does."""
        sample = self.samples[position]
        given, target, betas = sample.conditioning, sample.target, self.betas[int(sample.subject)]
        return FitSample(
            found=look_up(self.encoder, given, betas),
            axis_angle=motion_of(given.pose.joint_rotation),
            frames=frames_of(self.encoder, betas, target.pose)[1],
            target=target,
            subject=sample.subject,
            frame=sample.frame,
        )


def betas_of(captures: Captures) -> Float[Tensor, "people 10"]:
    """Everybody's betas of the default body.

    Raises:
        ConditioningError: somebody was captured on another body model.
        FileNotFoundError, CaptureFileError, ArrayFileError, BodyFileError: a camera has no pictures, a file is damaged.
    """
    return torch.stack([default_betas(captures.subject(name)) for name in captures.subjects])


def fit_dataset(captures: Captures, config: FitConfig) -> FitDataset:
    """The samples of a run."""
    settings = SampleSettings(config.views, config.targets, config.size, config.framing, config.conditioning_frame)
    return FitDataset(CaptureDataset(captures, settings, config.seed), PRESETS[config.encoder])


def fit_batches(dataset: FitDataset, config: FitConfig, start: Position, share: Share) -> Iterator[Batch]:
    """`batches` of a run; errors of the loader's workers are told as they would be without any.

    Raises:
        FileNotFoundError, CaptureFileError, ArrayFileError, BodyFileError: a file is missing or damaged.
        ChildProcessError: a worker was killed.
    """
    try:
        yield from batches(dataset, config.batch, start, config.workers, share)
    except (OSError, ValueError) as error:
        text = str(error)
        if not text.startswith(CAUGHT):
            raise
        raise type(error)(text.strip().splitlines()[-1].partition(": ")[2]) from error
    except RuntimeError as error:
        if "DataLoader worker" not in str(error):
            raise
        raise ChildProcessError(
            f"one of the {config.workers} processes that prepare samples was killed, as happens where memory runs out: "
            "resume with fewer --workers"
        ) from error
