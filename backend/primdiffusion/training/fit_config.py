"""Settings of a run of stage 1, saved as JSON with its weights."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Literal

from primdiffusion.encoder.config import PRESETS
from primdiffusion.training.config import RunSettings

Preset = Literal[
    "default",
    "shared_scale",
    "template_rt",
    "no_attention",
    "paper",
    "paper_shared_scale",
    "paper_template_rt",
    "paper_no_attention",
    "released",
]
AT_LEAST_ONE = (
    "steps",
    "batch",
    "views",
    "targets",
    "size",
    "evaluate_every",
)


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Weights of the terms of the objective, for colours in 0 ... 255 (SPEC 2); 0 disables a term."""

    rgb: float = 1.0
    """mean (I - I*)^2 / 16^2, sRGB-encoded."""
    silhouette: float = 2.0
    """mean |mask - alpha|. The released code has 0.01; a larger weight stops dark clothes from spreading over black."""
    volume: float = 0.0001
    """Sum over the boxes of the product of their half extents, in decimetres. The released code has 0.001; with it our
    boxes, which start smaller, shrink until gaps appear."""
    alpha_prior: float = 0.0
    """mean log(0.1 + a) + log(1.1 - a) + 2.20727; the released code has 1."""
    perceptual: float = 0.0
    """L1 distance of VGG19 features, [20, 5, .9, .5, .5]; the released code has 1. Needs `perceptual_weights`."""
    perceptual_weights: Path | None = None
    """A file of torchvision's VGG19 weights."""

    def __post_init__(self) -> None:
        """Raise ValueError for weights that are negative or not finite."""
        for name in ("rgb", "silhouette", "volume", "alpha_prior", "perceptual"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"loss.{name} is {getattr(self, name)}: it must be 0 or more")
        if not (self.rgb or self.perceptual):
            raise ValueError("neither loss.rgb nor loss.perceptual has a weight: nothing would teach colours")


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitConfig(RunSettings):
    """A run of `primdiffusion fit`."""

    data: Path
    """Captures to train on; packed ones load much faster."""
    held: Path | None = None
    """Captures of held-out subjects for evaluation."""
    encoder: Preset = "default"
    """default, its ablations shared_scale, template_rt and no_attention, the same four in the paper's form (paper,
    paper_shared_scale, ...), or the architecture released."""
    steps: int = 20_000
    """Optimiser steps; the learning rate decays to a tenth along a cosine."""
    batch: int = 4
    """Subjects per step and process."""
    views: int = 6
    """Input images; if a subject has fewer, some are used twice."""
    targets: int = 2
    """Target images of each subject."""
    size: int = 256
    """Width and height of the targets, pixels."""
    framing: Literal["whole", "crop"] = "crop"
    """crop: squares around the subject, of `size` pixels or more; whole: whole images, as in the paper."""
    conditioning_frame: Literal["first", "same", "any"] = "any"
    """Frame of the input images: the first, near T (released), that of the targets, or any."""
    step: float = 0.004
    """Metres between samples of a ray."""
    learning_rate: float = 2e-5
    """Learning rate of AdamW after a warm-up of 100 steps."""
    place_rate: float = 80.0
    """Factor on the learning rate of untied biases."""
    weight_decay: float = 0.0
    """Weight decay of AdamW."""
    gradient_clip: float = 1.0
    """Largest norm of the gradient."""
    ema: float = 0.998
    """Decay of the averaged weights, which are evaluated and saved."""
    hold_scale: int = 200
    """Steps with fixed delta scales (released: 2000)."""
    mixed_precision: Literal["no", "bf16"] = "no"
    """Precision of the network; the marcher runs in float32."""
    loss: LossConfig = dataclasses.field(default_factory=LossConfig)
    workers: int = 0
    """Data loading processes; 0 loads in the main process."""
    save_every: float = 120.0
    """Seconds between checkpoints; 0 saves after every step."""
    log_every: int = 25
    """Steps between lines of metrics.jsonl, which are running means."""
    evaluate_every: int = 500
    """Steps between evaluations on a few subjects of `data` and `held`."""
    pictures_every: int = 500
    """Steps between images."""

    def __post_init__(self) -> None:
        """Raise ValueError for values out of range."""
        super().__post_init__()
        for name in AT_LEAST_ONE:
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be 1 or more")
        for name in ("learning_rate", "place_rate", "step", "gradient_clip"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be above 0")
        for name in ("weight_decay", "hold_scale", "workers"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be 0 or more")
        if not 0 <= self.ema < 1:
            raise ValueError(f"ema is {self.ema}: it must be 0 or more, and below 1")
        if self.encoder not in PRESETS:
            raise ValueError(f"there is no encoder {self.encoder!r}: choose one of {', '.join(PRESETS)}")
        if self.loss.perceptual and self.loss.perceptual_weights is None:
            raise ValueError(
                "the perceptual loss needs a file of VGG19's weights: name it with --loss.perceptual-weights"
            )
