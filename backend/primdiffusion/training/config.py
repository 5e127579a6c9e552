"""Settings of a training run; saved as JSON beside its weights."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any, Literal, Protocol

from primdiffusion.diffusion.denoiser import DenoiserConfig
from primdiffusion.diffusion.unet import PAPER, UNetConfig

Weighting = Literal["whitened", "plain", "min_snr"]
Levels = Literal["uniform", "log_uniform", "log_normal"]


@dataclasses.dataclass(frozen=True)
class CodecConfig:
    """The frozen linear codec."""

    channels: int = 256
    """Latent channels of a primitive."""
    people: int = 160
    """People (geometry and colours) that the basis is fitted to, drawn at random."""


@dataclasses.dataclass(frozen=True)
class PriorConfig:
    """The closed-form person prior."""

    components: int = 128
    """Person components."""
    channels: int = 64
    """Leading latent channels in which person components live; they hold what whole people differ in."""
    groups: tuple[str, ...] = ("sex", "outfit", "pattern")
    """Attributes that people of one covariance have in common; those that the people do not have are left out."""
    features: tuple[tuple[str, ...], ...] = (("sex", "hair", "hat"), ("shoes",))
    """Attributes that move the mean of a group, each list on its own account; a part for each choice."""
    lean: float = 0.1
    """People of the covariance of all groups, in units of the number of components, that each group's is mixed with."""
    folds: int = 4
    """Parts of the people, each left out once, to measure how much of a component's variance holds for new people."""


@dataclasses.dataclass(frozen=True)
class PhaseConfig:
    """Training of one network."""

    steps: int
    """Optimiser steps; the learning rate falls to a tenth along a cosine over them."""
    batch: int
    """People, with noise of random level each, in a step."""
    learning_rate: float = 1e-3
    """AdamW's, after a warm-up of 100 steps."""
    weight_decay: float = 0.01
    """AdamW's."""
    gradient_clip: float = 1.0
    """Largest norm of a step's gradient."""
    ema: float = 0.999
    """Decay of the average of weights that is evaluated and shipped."""
    weighting: Weighting = "whitened"
    """Of x0 errors: whitened, in units of the closed form's posterior std; plain, as the paper; min_snr, plain times
    min(SNR of the level, gamma) (Hang et al. 2023)."""
    error_power: float = 1.0
    """Whitened errors, in units of posterior std s, are weighted by s^power: 2 is the paper's error on one level."""
    levels: Levels = "uniform"
    """Of noise that are trained: uniform in t, as the paper; log_uniform in noise over signal; log_normal, most of them
    about the spread of what is to be denoised (Karras et al. 2022), a fifth log_uniform."""
    min_snr_gamma: float = 5.0
    """Largest weight of a level with min_snr."""
    blend: float = 0.3
    """Share of people that are blends of the colour variants of one geometry. Default preset only."""
    unasked: float = 0.5
    """Share of people that are learnt without any attribute; the others with some of theirs. Default preset only."""
    evaluate_every: int = 500
    """Steps between evaluations on held-out people."""
    bfloat16: bool = False
    """Forward and backward of the network in bfloat16, where the device multiplies it faster."""

    def __post_init__(self) -> None:
        """Raises ValueError for values out of range."""
        for name in ("steps", "batch", "evaluate_every"):
            _check(name, getattr(self, name), getattr(self, name) >= 1, "1 or more")
        for name in ("learning_rate", "gradient_clip", "min_snr_gamma"):
            _check(name, getattr(self, name), 0 < getattr(self, name) < math.inf, "above 0")
        for name in ("weight_decay", "error_power"):
            _check(name, getattr(self, name), 0 <= getattr(self, name) < math.inf, "0 or more")
        for name in ("blend", "unasked"):
            _check(name, getattr(self, name), 0 <= getattr(self, name) <= 1, "from 0 to 1")
        _check("ema", self.ema, 0 <= self.ema < 1, "0 or more, and below 1")


@dataclasses.dataclass(frozen=True)
class TrainingConfig:
    """Train a diffusion model; the same command line resumes (docs/design/diffusion_training.md)."""

    data: Path
    """People of `primdiffusion payloads`: a folder of files, or of the shards that `payloads pack` makes of them."""
    run: Path
    """Folder for weights, metrics, pictures and this configuration; an unfinished run in it is resumed."""
    preset: Literal["default", "paper"] = "default"
    """default: a light network on latents; paper: the paper's U-Net on whole slabs, for graphics cards."""
    made_of: Literal["makehuman", "own"] = "own"
    """What the card says of the people: makehuman, those of `payloads` from MakeHuman's CC0 assets, with their licence
    and limits; own, nothing."""
    minutes: float | None = None
    """Stop after this time, to be resumed; None trains to the end."""
    seed: int = 0
    """Seed of all random numbers."""
    schedule: Literal["linear", "sqrt_linear", "fine_linear"] | None = None
    """Noise schedule over 1000 steps: linear (the paper's; None in the paper preset), fine_linear (the same from less
    noise on; None in the default preset) or sqrt_linear (the released code's)."""
    chain: Literal["trailing", "dense"] | None = None
    """Steps that the model is sampled in: trailing (evenly spaced; None in the paper preset) or dense (closer where
    there is little noise; None in the default preset)."""
    holdout: float = 0.05
    """Share of geometries, with all their colour variants, that is evaluated on and never trained on."""
    save_every: float = 60.0
    """Seconds between saved states: the most that a kill can lose. 0 saves after every step."""
    threads: int | None = None
    """Processor threads; None leaves torch's choice."""
    log_every: int = 50
    """Steps between lines of metrics.jsonl; what they hold are running means."""
    pictures_every: int = 1000
    """Steps between pictures of a few people that the averaged weights generate."""
    codec: CodecConfig = dataclasses.field(default_factory=CodecConfig)
    prior: PriorConfig = dataclasses.field(default_factory=PriorConfig)
    model: DenoiserConfig = dataclasses.field(default_factory=DenoiserConfig)
    person: PhaseConfig = dataclasses.field(
        default_factory=lambda: PhaseConfig(steps=8000, batch=256, evaluate_every=1000)
    )
    """The default preset's network over person components, trained first."""
    local: PhaseConfig = dataclasses.field(
        default_factory=lambda: PhaseConfig(
            steps=38_000, batch=16, blend=0.2, weight_decay=0.0, levels="log_normal", bfloat16=True
        )
    )
    """The default preset's network over the grid."""
    unet: UNetConfig = PAPER
    """Size of the paper preset's network."""
    slab: PhaseConfig = dataclasses.field(
        default_factory=lambda: PhaseConfig(
            steps=200_000, batch=8, learning_rate=1e-5, weight_decay=0.0, ema=0.9999, weighting="plain",
            evaluate_every=5000, bfloat16=True,
        )
    )  # fmt: skip
    """The paper preset's only phase; the batch is that of each process."""

    def __post_init__(self) -> None:
        """Fills in what follows from the preset; raises ValueError for values out of range."""
        usual = {"default": ("fine_linear", "dense"), "paper": ("linear", "trailing")}[self.preset]
        for name, value in zip(("schedule", "chain"), usual, strict=True):
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        for name in ("log_every", "pictures_every", "threads"):
            value = getattr(self, name)
            _check(name, value, value is None or value >= 1, "1 or more")
        for name in ("minutes", "save_every"):
            value = getattr(self, name)
            _check(name, value, value is None or value >= 0, "0 or more")
        _check("holdout", self.holdout, 0 < self.holdout < 1, "between 0 and 1")
        if self.preset == "paper" and self.slab.weighting == "whitened":
            raise ValueError("slab.weighting is whitened, for which slabs have no closed form: choose plain or min_snr")


def _check(name: str, value: object, fits: bool, wanted: str) -> None:
    if not fits:
        raise ValueError(f"{name} is {value}: it must be {wanted}")


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
        "loss.perceptual_weights",
    )
)
"""Settings that may change when a run is resumed. None affects a step, except `steps`, which stretches the rest of the
learning rate's cosine."""


class RunConfig(Protocol):
    """Settings of a run of either stage: a dataclass with its folder and its data."""

    @property
    def run(self) -> Path: ...
    @property
    def data(self) -> Path: ...


def check_resumable(saved: str, config: RunConfig) -> None:
    """ValueError that names the settings in which a saved run differs from `config`, except when to stop."""
    try:
        before = _comparable(json.loads(saved))
    except (ValueError, AttributeError) as error:
        raise ValueError(f"the settings in {config.run} are damaged ({error}): give a new folder") from error
    now = _comparable(json.loads(to_json(config)))
    changed = sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key))
    if changed:
        differing = ", ".join(f"{key} ({before.get(key)}, not {now.get(key)})" for key in changed)
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
