"""Settings of a training run; saved as JSON beside its weights."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal, Protocol

from primdiffusion.diffusion.denoiser import DenoiserConfig
from primdiffusion.staging import written_whole


@dataclasses.dataclass(frozen=True)
class CodecConfig:
    """The frozen linear codec."""

    channels: int = 96
    """Latent channels of a primitive."""
    people: int = 160
    """People (geometry and colours) that the basis is fitted to, drawn at random."""


@dataclasses.dataclass(frozen=True)
class PriorConfig:
    """The closed-form person prior."""

    components: int = 128
    """Person components."""
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
    error_power: float = 1.0
    """Errors in units of posterior std s are weighted by s^power: 0 whitened, 2 the paper's plain squares."""
    blend: float = 0.3
    """Share of people that are blends of the colour variants of one geometry."""
    unasked: float = 0.5
    """Share of people that are learnt without any attribute; the others with some of theirs."""
    evaluate_every: int = 500
    """Steps between evaluations on held-out people."""
    bfloat16: bool = False
    """Forward and backward in bfloat16, where the processor multiplies it faster."""


@dataclasses.dataclass(frozen=True)
class TrainingConfig:
    """A run of `python -m primdiffusion.training.diffuse`."""

    data: Path
    """Folder of people: one .npz each, as `people` writes them."""
    run: Path
    """Folder for weights, metrics and this configuration; an unfinished run in it is resumed."""
    minutes: float | None = None
    """Stop after this time, to be resumed; None trains to the end."""
    seed: int = 0
    """Of everything random."""
    schedule: Literal["linear", "sqrt_linear"] = "linear"
    """Noise schedule over 1000 steps."""
    holdout: float = 0.05
    """Share of geometries, with all their colour variants, that is evaluated on and never trained on."""
    save_every: float = 60.0
    """Seconds between checkpoints."""
    threads: int | None = None
    """Processor threads; None leaves torch's choice."""
    codec: CodecConfig = dataclasses.field(default_factory=CodecConfig)
    prior: PriorConfig = dataclasses.field(default_factory=PriorConfig)
    model: DenoiserConfig = dataclasses.field(default_factory=DenoiserConfig)
    person: PhaseConfig = dataclasses.field(
        default_factory=lambda: PhaseConfig(steps=5000, batch=256, evaluate_every=1000)
    )
    local: PhaseConfig = dataclasses.field(
        default_factory=lambda: PhaseConfig(steps=8000, batch=16, blend=0.2, weight_decay=0.0, bfloat16=True)
    )


def to_json(config: Any) -> str:
    """The configuration as readable JSON."""
    return json.dumps(dataclasses.asdict(config), indent=2, default=str)


MAY_CHANGE = frozenset(
    (
        "run",
        "data",
        "held",
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
"""Settings that a resumed run may be given anew. None changes what a step does, but for `steps`: it stretches what is
left of the learning rate's cosine."""


class RunConfig(Protocol):
    """Any run's settings: a dataclass that says where its folder is."""

    @property
    def run(self) -> Path: ...  # noqa: D102


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
        raise ValueError(f"the run in {config.run} was begun with another {differing}: give the same, or a new folder")


def _comparable(tree: dict, prefix: str = "") -> dict[str, object]:
    flat = {}
    for key, value in tree.items():
        name = prefix + key
        if isinstance(value, dict):
            flat |= _comparable(value, f"{name}.")
        elif name not in MAY_CHANGE:
            flat[name] = value
    return {key: value for key, value in flat.items() if not key.endswith((".steps", ".evaluate_every"))}


def write_atomically(path: Path, content: str | bytes) -> None:
    """The whole file or none, and nothing beside it. Raises OSError, which names `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as unfinished:
        unfinished.write_bytes(content.encode() if isinstance(content, str) else content)
