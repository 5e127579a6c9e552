"""Settings of stage 1's training; saved as JSON beside its weights."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Literal

from primdiffusion.encoder.config import PRESETS

Preset = Literal["default", "shared_scale", "template_rt", "no_attention", "paper", "released"]
AT_LEAST_ONE = (
    "steps",
    "batch",
    "views",
    "targets",
    "size",
    "threads",
    "log_every",
    "evaluate_every",
    "pictures_every",
)


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Weights of the terms; colours count 0 ... 255 as in SPEC 2. 0 leaves a term out."""

    rgb: float = 1.0
    """mean (I - I*)^2 / 16^2, sRGB-encoded."""
    silhouette: float = 2.0
    """mean |mask - alpha|. The released code has 0.01; ours keeps dark clothes on black from growing."""
    volume: float = 0.0001
    """Sum over the boxes of the product of their half extents, in decimetres. The released code has 0.001; with it our
    boxes, which start smaller, shrink until they part: its pull is small, but the same in every step."""
    alpha_prior: float = 0.0
    """mean log(0.1 + a) + log(1.1 - a) + 2.20727; the released code has 1."""
    perceptual: float = 0.0
    """L1 of VGG19's features, [20, 5, .9, .5, .5]; the released code has 1. Needs `perceptual_weights`."""
    perceptual_weights: Path | None = None
    """A file of torchvision's VGG19 weights."""

    def __post_init__(self) -> None:
        """Raises ValueError for weights that are negative or not finite."""
        for name in ("rgb", "silhouette", "volume", "alpha_prior", "perceptual"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"loss.{name} is {getattr(self, name)}: it must be 0 or more")
        if not (self.rgb or self.perceptual):
            raise ValueError("neither loss.rgb nor loss.perceptual has a weight: nothing would teach colours")


@dataclasses.dataclass(frozen=True)
class FitConfig:
    """A run of `primdiffusion fit`."""

    data: Path
    """Captures to train on; packed ones are read much faster."""
    run: Path
    """Folder for weights, metrics, pictures and this configuration; an unfinished run in it is resumed."""
    held: Path | None = None
    """Captures of other people to measure on now and then."""
    encoder: Preset = "default"
    """default, its ablations shared_scale, template_rt and no_attention, or the architectures paper and released."""
    steps: int = 20_000
    """Optimiser steps; the learning rate falls to a tenth along a cosine over them."""
    batch: int = 4
    """People in a step, of each process."""
    views: int = 6
    """Pictures that the encoder is given; where a person has fewer, some are given twice."""
    targets: int = 2
    """Pictures that are compared, of each person."""
    size: int = 256
    """Pixels a side of these."""
    framing: Literal["whole", "crop"] = "crop"
    """crop: squares about the person, of `size` pixels or more; whole: the pictures, as the paper's."""
    conditioning_frame: Literal["first", "same", "any"] = "any"
    """Pose in which the encoder sees the person: near T (released), that of the targets, or any."""
    step: float = 0.004
    """Metres between samples of a ray."""
    learning_rate: float = 2e-5
    """AdamW's, after a warm-up of 100 steps."""
    place_rate: float = 80.0
    """Times as fast learn the biases that every place of the UV square has of its own."""
    weight_decay: float = 0.0
    """AdamW's."""
    gradient_clip: float = 1.0
    """Largest norm of a step's gradient."""
    ema: float = 0.998
    """Decay of the average of weights that is evaluated and shipped."""
    hold_scale: int = 200
    """Steps in which delta scales stay 1 (released: 2000)."""
    mixed_precision: Literal["no", "bf16"] = "no"
    """Of the network; the marcher computes in float32."""
    loss: LossConfig = dataclasses.field(default_factory=LossConfig)
    seed: int = 0
    """Of everything random."""
    minutes: float | None = None
    """Stop after this time, to be resumed; None trains to the end."""
    workers: int = 0
    """Processes that prepare samples; 0 does it in between."""
    threads: int | None = None
    """Processor threads; None leaves torch's choice."""
    save_every: float = 120.0
    """Seconds between checkpoints: what a kill can lose. 0 writes one after every step."""
    log_every: int = 25
    """Steps between lines of metrics.jsonl; what they hold are running means."""
    evaluate_every: int = 500
    """Steps between measurements on a few people of `data` and of `held`."""
    pictures_every: int = 500
    """Steps between pictures."""

    def __post_init__(self) -> None:
        """Raises ValueError for settings that cannot be."""
        for name in AT_LEAST_ONE:
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be 1 or more")
        for name in ("learning_rate", "place_rate", "step", "gradient_clip"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be above 0")
        for name in ("weight_decay", "hold_scale", "workers", "save_every", "minutes"):
            if not (getattr(self, name) or 0) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be 0 or more")
        if not 0 <= self.ema < 1:
            raise ValueError(f"ema is {self.ema}: it must be 0 or more, and below 1")
        if self.encoder not in PRESETS:
            raise ValueError(f"there is no encoder {self.encoder!r}: choose one of {', '.join(PRESETS)}")
        if self.loss.perceptual and self.loss.perceptual_weights is None:
            raise ValueError(
                "the perceptual loss needs a file of VGG19's weights: name it with --loss.perceptual-weights"
            )
