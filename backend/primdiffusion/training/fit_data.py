"""Samples of stage 1: unprojected input images, and target images."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from primdiffusion.capture.conditioning import default_betas
from primdiffusion.capture.dataset import (
    CaptureDataset,
    Position,
    ProcessRank,
    SampleSet,
    batches,
)
from primdiffusion.capture.reader import Captures, Views
from primdiffusion.encoder.config import EncoderConfig
from primdiffusion.encoder.model import frames_of, unproject_views
from primdiffusion.encoder.network import motion_of
from primdiffusion.encoder.texture import erode
from primdiffusion.encoder.unproject import Unprojected
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import Frames
from primdiffusion.training.fit_config import FitConfig

CAUGHT = "Caught "
"""Start of the messages with which torch's loader wraps errors of workers; their traceback follows."""


@dataclasses.dataclass(frozen=True)
class FitSample(TensorRecord):
    """One subject, or a batch."""

    found: Unprojected
    """The unprojected input images."""
    axis_angle: Float[Tensor, "*b 24 3"]
    """Pose of the input images."""
    frames: Frames
    """Frames of the boxes in the pose of the targets, before delta scales."""
    target: Views
    subject: Int64[Tensor, "*b"]
    frame: Int64[Tensor, "*b"]
    """Frame of the targets."""


Batch = tuple[FitSample, Position]
"""Samples, and the position after them."""


class FitDataset(SampleSet[FitSample]):
    """Samples of a `CaptureDataset`, unprojected in the workers that load them."""

    def __init__(self, samples: CaptureDataset, encoder: EncoderConfig) -> None:
        """Raises as `betas_of`, so that invalid subjects are errors before training starts."""
        self.samples, self.encoder = samples, encoder
        self.betas = betas_of(samples.captures)

    def __len__(self) -> int:
        """Number of samples in an epoch."""
        return len(self.samples)

    def __getitem__(self, position: tuple[int, int]) -> FitSample:
        """Load the sample at a position. Raises as `CaptureDataset`."""
        sample = self.samples[position]
        given, target, betas = sample.conditioning, sample.target, self.betas[int(sample.subject)]
        return FitSample(
            found=unproject_views(self.encoder, given, betas),
            axis_angle=motion_of(given.pose.joint_rotation),
            frames=frames_of(self.encoder, betas, target.pose)[1],
            target=erode(target) if self.encoder.masks == "eroded" else target,
            subject=sample.subject,
            frame=sample.frame,
        )


def betas_of(captures: Captures) -> Float[Tensor, "people 10"]:
    """Return the betas of all subjects on the default body.

    Raises:
        ValueError: a subject was captured on another body model.
        FileNotFoundError, FileError: a camera has no images, a file is damaged.
    """
    return torch.stack([default_betas(captures.subject(name)) for name in captures.subjects])


def fit_dataset(captures: Captures, config: FitConfig) -> FitDataset:
    """Return the dataset of a run."""
    return FitDataset(CaptureDataset(captures, config, config.seed), config.architecture)


def fit_batches(dataset: FitDataset, config: FitConfig, start: Position, share: ProcessRank) -> Iterator[Batch]:
    """Yield the batches of a run, with the original errors of worker processes.

    Raises:
        FileNotFoundError, FileError: a file is missing or damaged.
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
            f"one of the {config.workers} processes that load samples was killed, perhaps because memory ran out: "
            "resume with fewer --workers"
        ) from error
