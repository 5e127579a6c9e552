"""Settings of a training run; saved as JSON beside its weights."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from primdiffusion.diffusion.denoiser import LocalUNetConfig
from primdiffusion.diffusion.unet import PAPER, UNetConfig
from primdiffusion.files.json_files import parse_json
from primdiffusion.files.regular_files import as_file_error
from primdiffusion.formats.requests import Count, Fraction, NotNegative, Positive
from primdiffusion.formats.schema import Checked, Range

Tracker = Literal["tensorboard", "wandb"]
Levels = Literal["uniform", "log_normal"]
Decay = Annotated[float, Range(0, 0.999999)]


@dataclasses.dataclass(frozen=True)
class CodecConfig:
    """The frozen linear codec."""

    channels: int = 320
    """Latent channels of a primitive."""
    people: int = 240
    """Randomly chosen samples (geometry and colours) to which the basis is fitted."""


@dataclasses.dataclass(frozen=True)
class PriorConfig:
    """The closed-form person prior."""

    components: int = 192
    """Person components of each part of the body."""
    channels: int = 128
    """Leading latent channels that the person components span; global differences are in these."""
    groups: tuple[str, ...] = ("sex", "outfit", "pattern")
    """Attributes that define the groups, each with its own covariance of clothes; attributes missing in the data are
    ignored."""
    heads: tuple[str, ...] = ("sex", "hair", "hat")
    """Attributes that define the heads, each with its own covariance."""
    outfit: str = "outfit"
    """The one of `groups` that says what is worn: all who wear the same share the covariance of colours, and show skin
    in the same places."""
    hair: str = "hair"
    """The same of `heads`."""
    hanging: tuple[str, ...] = ("long", "ponytail", "braid")
    """Values of `heads` with hair that hangs over the clothes and covers a part of them."""
    features: tuple[tuple[str, ...], ...] = (("shoes",),)
    """Further attributes that shift the mean, each list independently."""
    axes: int = 64
    """Principal axes of a covariance."""
    shared: int = 4
    """Directions of the skin, which clothes and heads share."""
    shrinkage: float = 10.0
    """Shrinkage of the details in the groups' covariances to those of all data: its weight as samples."""
    folds: int = 4
    """Folds of the cross-validation that measures how much variance of each component generalises to new people."""


@dataclasses.dataclass(frozen=True)
class OptimiserSettings(Checked):
    """Optimisation of one network."""

    steps: Count
    """Optimiser steps; the learning rate decays to a tenth along a cosine."""
    batch: Count
    """Samples per step and process."""
    learning_rate: Positive = 1e-3
    """Learning rate of AdamW after a warm-up of 100 steps."""
    weight_decay: NotNegative = 0.01
    """Weight decay of AdamW."""
    gradient_clip: Positive = 1.0
    """Largest norm of the gradient."""
    ema: Decay = 0.999
    """Decay of the averaged weights, which are evaluated and saved."""
    evaluate_every: Count = 500
    """Steps between evaluations on held-out people."""


@dataclasses.dataclass(frozen=True)
class NetworkTraining(OptimiserSettings):
    """Training of one network of a diffusion model, each sample at a random noise level."""

    optimiser: Literal["adamw", "muon"] = "adamw"
    """adamw; or muon, Muon for hidden layers at three times the learning rate, AdamW for the rest. Muon is for the
    default preset, and computes in bfloat16: devices without instructions for it take AdamW."""
    levels: Levels = "uniform"
    """Distribution of noise levels: uniform in t, as in the paper; log_normal in noise over signal, near the spread of
    what is denoised (Karras et al. 2022), with a fifth of all levels evenly in its logarithm."""
    blend_fraction: Fraction = 0.3
    """Fraction of samples that blend the colour variants of one geometry. Default preset only."""
    unasked: Fraction = 0.5
    """Fraction of samples trained without attributes; the others have a random subset. Default preset only."""
    bfloat16: bool = False
    """Run the network in bfloat16 where the device multiplies it faster than float32."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunSettings(Checked):
    """Place of a run, and how it is stopped, measured and saved: the same for every task."""

    data: Path
    """Training set."""
    run: Annotated[Path, tyro.conf.arg(aliases=("--run-folder",))]
    """Folder of the run: weights, metrics, images and settings; an unfinished run is resumed. --run-folder is the same,
    for torchrun, which takes --run for its own --run-path."""
    minutes: NotNegative | None = None
    """Time limit, after which the run can be resumed; 0 writes the model of the last saved state."""
    seed: int = 0
    """Seed of all random numbers."""
    save_every: NotNegative = 60.0
    """Seconds between checkpoints; 0 saves after every step."""
    threads: Count | None = None
    """CPU threads; the default is torch's."""
    log_every: Count = 50
    """Steps between lines of metrics.jsonl, which are running means."""
    pictures_every: Count = 1000
    """Steps between images made with the averaged weights."""
    tracker: Tracker | None = None
    """Tracker of metrics besides metrics.jsonl: tensorboard or wandb, of pip install "primdiffusion[tracking]"."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingConfig(RunSettings):
    """Train a diffusion model; the same command line resumes (docs/design/diffusion_training.md)."""

    data: Path
    """Training set: a folder of `primdiffusion payloads`."""
    holdout: Annotated[float, Range(1e-6, 0.999999)] = 0.05
    """Fraction of geometries, with all their colour variants, held out for evaluation."""
    preset: Literal["default", "paper"] = "default"
    """default: a light network on latents; paper: the paper's U-Net on whole slabs, for GPUs."""
    made_of: Literal["makehuman", "own"] = "own"
    """Data in the model card: makehuman, licence and limits of `payloads` from MakeHuman's CC0 assets; own, none."""
    start_from: Path | None = None
    """Checkpoint of the default preset to go on from in a new run: its codec, closed form, attributes and size of the
    network are kept, and the network starts with its weights."""
    codec: CodecConfig = dataclasses.field(default_factory=CodecConfig)
    prior: PriorConfig = dataclasses.field(default_factory=PriorConfig)
    model: LocalUNetConfig = dataclasses.field(default_factory=LocalUNetConfig)
    local: NetworkTraining = dataclasses.field(
        default_factory=lambda: NetworkTraining(
            steps=38_000, batch=16, blend_fraction=0.2, weight_decay=0.0, levels="log_normal", bfloat16=True,
            optimiser="muon",
        )
    )  # fmt: skip
    """Training of the default preset's network."""
    unet: UNetConfig = PAPER
    """Size of the paper preset's network."""
    slab: NetworkTraining = dataclasses.field(
        default_factory=lambda: NetworkTraining(
            steps=200_000, batch=8, learning_rate=1e-5, weight_decay=0.0, ema=0.9999, evaluate_every=5000,
            bfloat16=True,
        )
    )  # fmt: skip
    """Training of the paper preset's network; the batch is that of each process."""

    def __post_init__(self) -> None:
        """Raise ValueError for values out of range, or that the preset has not."""
        super().__post_init__()
        if self.preset == "paper" and self.slab.optimiser == "muon":
            raise ValueError("slab.optimiser is muon, which is for the default preset: choose adamw")
        if self.preset == "paper" and self.start_from is not None:
            raise ValueError("start_from is for the default preset: leave it out, or give --preset default")


def to_json(config: Any) -> str:
    """The configuration as readable JSON."""
    return json.dumps(dataclasses.asdict(config), indent=2, default=str)


MAY_CHANGE = frozenset(
    (
        "run",
        "data",
        "held",
        "made_of",
        "minutes",
        "save_every",
        "threads",
        "workers",
        "steps",
        "evaluate_every",
        "pictures_every",
        "log_every",
        "tracker",
        "loss.perceptual_weights",
    )
)
"""Settings that may change when a run is resumed. None affects a step, except `steps`, which stretches the rest of the
learning rate's cosine."""


def check_resumable(saved: str, config: RunSettings) -> None:
    """Raise ValueError, naming the settings in which a saved run differs from `config`, except those allowed to."""
    with as_file_error(config.run, "has damaged settings", "give a new folder"):
        before = _comparable(parse_json(saved))
    now = _comparable(parse_json(to_json(config)))
    changed = sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key))
    if changed:
        differing = ", ".join(f"{key:.30} ({before.get(key)!s:.20}, not {now.get(key)!s:.20})" for key in changed[:2])
        differing += f" and {len(changed) - 2} more" if len(changed) > 2 else ""
        raise ValueError(f"the run in {config.run} began with another {differing}: give the same, or a new folder")


def _comparable(tree: dict, prefix: str = "") -> dict[str, object]:
    flat = {}
    for key, value in tree.items():
        name = prefix + key
        if isinstance(value, dict):
            flat |= _comparable(value, f"{name}.")
        elif name not in MAY_CHANGE:
            flat[name] = value
    return {key: value for key, value in flat.items() if not key.endswith((".steps", ".evaluate_every"))}
