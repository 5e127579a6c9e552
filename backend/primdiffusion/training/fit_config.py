"""Settings of a run of stage 1, saved as JSON with its weights."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from primdiffusion.capture.dataset import SampleSettings
from primdiffusion.encoder.config import Ablation, EncoderConfig, Preset, encoder_config
from primdiffusion.formats.requests import Count, NotNegative, Positive
from primdiffusion.formats.schema import Checked, Range
from primdiffusion.training.config import Decay, OptimiserSettings, RunSettings


@dataclasses.dataclass(frozen=True)
class LossConfig(Checked):
    """Weights of the terms of the objective, for colours in 0 ... 255 (SPEC 2); 0 disables a term."""

    rgb: NotNegative = 1.0
    """mean (I - I*)^2 / 16^2, sRGB-encoded."""
    silhouette: NotNegative = 2.0
    """mean |mask - alpha|. The released code has 0.01; a larger weight stops dark clothes from spreading over black."""
    volume: NotNegative = 0.0001
    """Sum over the boxes of the product of their half extents, in decimetres. The released code has 0.001; with it our
    boxes, which start smaller, shrink until gaps appear."""
    alpha_prior: NotNegative = 0.0
    """mean log(0.1 + a) + log(1.1 - a) + 2.20727; the released code has 1."""
    perceptual: NotNegative = 0.0
    """L1 distance of VGG19 features, [20, 5, .9, .5, .5]; the released code has 1. Needs `perceptual_weights`."""
    perceptual_weights: Path | None = None
    """A file of torchvision's VGG19 weights."""

    def __post_init__(self) -> None:
        """Raise ValueError for weights that are negative or not finite, and without a weight of colours."""
        super().__post_init__()
        if not (self.rgb or self.perceptual):
            raise ValueError("loss.rgb and loss.perceptual have no weight: nothing would teach colours")


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitConfig(OptimiserSettings, SampleSettings, RunSettings):
    """A run of `primdiffusion fit`."""

    data: Path
    """Captures to train on."""
    held: Path | None = None
    """Captures of held-out subjects for evaluation."""
    encoder: Preset = "default"
    """The shipped architecture, the paper's, or that of the authors' code."""
    ablation: Ablation | None = None
    """An ablation of the paper's Table 3: one delta scale for all boxes (shared_scale), boxes on a body of mean shape
    (template_rt), or branches that are only concatenated (no_attention)."""
    start: Path | None = None
    """Encoder of the same architecture whose weights training starts from, for instance the default one; without
    it, random weights, which draw the hull of the masks."""
    steps: Count = 20_000
    """Optimiser steps; the learning rate decays to a tenth along a cosine."""
    batch: Count = 4
    """Subjects per step and process."""
    step: Positive = 0.004
    """Metres between samples of a ray."""
    learning_rate: Positive = 1e-4
    """Learning rate of AdamW after a warm-up of 100 steps."""
    place_rate: Positive = 16.0
    """Factor on the learning rate of untied biases."""
    weight_decay: NotNegative = 0.0
    """Weight decay of AdamW."""
    ema: Decay = 0.998
    """Decay of the averaged weights, which are evaluated and saved."""
    hold_scale: Annotated[int, Range(0)] = 1_000_000
    """Steps with fixed delta scales (released: 2000). Boxes that start from the masks' hull should keep their size:
    free ones shrink until gaps appear."""
    mixed_precision: Literal["no", "bf16"] = "no"
    """Precision of the network; the marcher runs in float32."""
    loss: LossConfig = dataclasses.field(default_factory=LossConfig)
    workers: Annotated[int, Range(0)] = 0
    """Data loading processes; 0 loads in the main process."""
    save_every: NotNegative = 120.0
    """Seconds between checkpoints; 0 saves after every step."""
    log_every: Count = 25
    """Steps between lines of metrics.jsonl, which are running means."""
    pictures_every: Count = 500
    """Steps between images."""

    @property
    def architecture(self) -> EncoderConfig:
        """Settings of the encoder."""
        return encoder_config(self.encoder, self.ablation)

    def __post_init__(self) -> None:
        """Raise ValueError for values out of range."""
        super().__post_init__()
        if self.loss.perceptual and self.loss.perceptual_weights is None:
            raise ValueError(
                "the perceptual loss needs a file of VGG19's weights: name it with --loss.perceptual-weights"
            )
