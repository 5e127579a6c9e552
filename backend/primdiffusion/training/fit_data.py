"""Samples of stage 1: what the encoder reads of a person, and pictures that the result is compared with."""

from __future__ import annotations

import dataclasses

from jaxtyping import Float, Int64
from torch import Tensor
from torch.utils.data import Dataset

from primdiffusion.capture.dataset import CaptureDataset, SampleSettings, Views
from primdiffusion.capture.reader import Captures
from primdiffusion.encoder.config import PRESETS, EncoderConfig
from primdiffusion.encoder.encode import frames_of, look_up
from primdiffusion.encoder.network import motion_of
from primdiffusion.encoder.unproject import Unprojected
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.primitives import Frames
from primdiffusion.training.fit_config import FitConfig


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


class FitDataset(Dataset[FitSample]):
    """`CaptureDataset`'s samples, unprojected where they are read: in the loader's workers."""

    def __init__(self, samples: CaptureDataset, encoder: EncoderConfig) -> None:
        self.samples, self.encoder = samples, encoder

    def __len__(self) -> int:
        """Samples of an epoch."""
        return len(self.samples)

    def __getitem__(self, position: tuple[int, int]) -> FitSample:
        """The sample at a position. Raises what `CaptureDataset` does, and ValueError for betas of another body."""
        sample = self.samples[position]
        given, target = sample.conditioning, sample.target
        return FitSample(
            found=look_up(self.encoder, given, sample.betas),
            axis_angle=motion_of(given.pose.joint_rotation),
            frames=frames_of(self.encoder, sample.betas, target.pose)[1],
            target=target,
            subject=sample.subject,
            frame=sample.frame,
        )


def fit_dataset(captures: Captures, config: FitConfig) -> FitDataset:
    """The samples of a run."""
    settings = SampleSettings(config.views, config.targets, config.size, config.framing, config.conditioning_frame)
    return FitDataset(CaptureDataset(captures, settings, config.seed), PRESETS[config.encoder])
