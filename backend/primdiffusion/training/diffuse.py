"""Stage 2: train the default denoiser on people (paper sec. 3.3). `python -m primdiffusion.training.diffuse --help`."""

from __future__ import annotations

import dataclasses
import json
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import torch
import tyro
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn

from primdiffusion import __version__
from primdiffusion.diffusion.codec import LinearCodec
from primdiffusion.diffusion.conditioning import Vocabulary
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.gaussian import PersonPrior
from primdiffusion.diffusion.model import CellCodec, DiffusionModel, ShapePrior
from primdiffusion.diffusion.schedule import SCHEDULES
from primdiffusion.training.checkpoint import save_checkpoint
from primdiffusion.training.config import PhaseConfig, TrainingConfig, check_resumable, to_json, write_atomically
from primdiffusion.training.interrupt import Interrupt
from primdiffusion.training.latents import (
    LatentSet,
    encode_people,
    find_people,
    fit_codec_to,
    read_vocabulary,
    split_people,
)
from primdiffusion.training.losses import PersonObjective, RestObjective, closed_form, x0_errors
from primdiffusion.training.prior import fit_prior, fit_shapes
from primdiffusion.training.state import TrainingState

log = logging.getLogger(__name__)

LIMITS = (
    "The people are adults from MakeHuman's bodies, in twelve outfits, six pairs of shoes and ten hair styles, with "
    "colours and patterns drawn at random: no robes, uniforms, beards, glasses, wheelchairs or children.",
    "Primitives are 6 to 17 mm a voxel and the codec keeps 64 of 2048 numbers: faces, stripes and prints are soft.",
    "Patterns of two garments can blend into one, and a garment can change its colour at the sleeves.",
    "Body shapes are drawn from a Gaussian given the person; they suit the clothes on average only.",
    "Sampling in few steps makes people more alike than those trained on; more steps let them differ more.",
)
"""What a user of such a checkpoint should know; stated on its card."""


@dataclasses.dataclass(frozen=True)
class Prepared:
    """Everything a run computes in closed form before it trains."""

    train: LatentSet
    held: LatentSet
    codec: LinearCodec
    prior: PersonPrior
    shapes: ShapePrior
    vocabulary: Vocabulary
    full_density: float


class Objective(Protocol):
    """A network and a loss for it."""

    @property
    def network(self) -> nn.Module:
        """What is trained."""
        ...

    def loss(self, generator: torch.Generator) -> Tensor:
        """Of a random batch."""
        ...


def prepare(config: TrainingConfig) -> Prepared:
    """Codec, latents, prior and body shapes of the run's people; read back from the run folder when they are there."""
    path = config.run / "prepared.safetensors"
    if path.exists():
        return _load_prepared(path)
    paths = find_people(config.data)
    train_paths, held_paths = split_people(paths, config.holdout, config.seed)
    generator = torch.Generator().manual_seed(config.seed)
    vocabulary = read_vocabulary(train_paths)
    codec = fit_codec_to(train_paths, config.codec, generator)
    train, full_density = encode_people(train_paths, codec, vocabulary)
    held, _ = encode_people(held_paths, codec, vocabulary)
    prior = fit_prior(train, codec, vocabulary, config.prior)
    prepared = Prepared(train, held, codec, prior, fit_shapes(train, prior), vocabulary, full_density)
    _save_prepared(path, prepared)
    write_atomically(
        config.run / "people.json",
        json.dumps({"train": [p.stem for p in train_paths], "held": [p.stem for p in held_paths]}),
    )
    return prepared


def fit(
    objective: Objective,
    state: TrainingState,
    path: Path,
    interrupt: Interrupt,
    save_every: float,
    evaluate: Callable[[TrainingState], dict[str, float]],
    record: Callable[[dict[str, object]], None],
) -> bool:
    """Train until the phase's last step (True) or the interrupt (False); saves now and then, and at the end."""
    config = state.config
    saved = started = time.monotonic()
    mean_loss = 0.0
    while state.step < config.steps and not interrupt.due():
        state.network.train()
        loss = objective.loss(state.generator)
        state.update(loss)
        mean_loss += (float(loss.detach()) - mean_loss) / min(state.step, 200)
        if state.step % config.evaluate_every == 0 or state.step == config.steps:
            record(
                {
                    "step": state.step,
                    "seconds": state.seconds + time.monotonic() - started,
                    "loss": mean_loss,
                    **evaluate(state),
                }
            )
        if time.monotonic() - saved > save_every:
            saved = time.monotonic()
            _save_state(state, path, saved - started)
            started = saved
    _save_state(state, path, time.monotonic() - started)
    return state.step >= config.steps


def train(config: TrainingConfig) -> DiffusionModel:
    """Run or resume a training run; returns the model as far as it got, which is also in run/model.safetensors."""
    if config.threads:
        torch.set_num_threads(config.threads)
    saved = config.run / "config.json"
    if saved.exists():
        check_resumable(saved.read_text(), config)
    write_atomically(saved, to_json(config))
    prepared = prepare(config)
    torch.manual_seed(config.seed)
    denoiser = PersonDenoiser(config.model, prepared.prior, SCHEDULES[config.schedule]())
    denoiser.eval().requires_grad_(False)
    steps = {}
    with Interrupt(config.minutes) as interrupt:
        for name, phase in (("person", config.person), ("local", config.local)):
            if getattr(denoiser, name) is not None:
                steps[name] = _train_phase(name, phase, config, prepared, denoiser, interrupt)
    model = DiffusionModel(
        denoiser,
        denoiser.schedule,
        CellCodec(prepared.codec),
        prepared.shapes,
        prepared.full_density,
        _card(config, prepared, denoiser, steps),
        prepared.vocabulary,
    )
    save_checkpoint(config.run / "model.safetensors", model, config.schedule)
    return model


def _train_phase(
    name: str,
    phase: PhaseConfig,
    config: TrainingConfig,
    prepared: Prepared,
    denoiser: PersonDenoiser,
    interrupt: Interrupt,
) -> int:
    """Train one network as far as time allows and leave its averaged weights in place; returns its steps."""
    network = getattr(denoiser, name)
    state = TrainingState(network.requires_grad_(True), phase, config.seed + 1)
    path = config.run / f"{name}.state.safetensors"
    if path.exists():
        state.load(path)
    objective = _objective(name, phase, prepared, denoiser)
    denoiser.network_dtype = torch.bfloat16 if phase.bfloat16 else torch.float32

    def evaluate(state: TrainingState) -> dict[str, float]:
        setattr(denoiser, name, state.average)
        errors = x0_errors({"rms": denoiser}, denoiser, prepared.held.latents)["rms"]
        setattr(denoiser, name, network)
        return {f"rms_{level}": error for level, error in errors.items()}

    def record(row: dict[str, object]) -> None:
        log.info(
            "%s %s", name, " ".join(f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items())
        )
        with (config.run / "metrics.jsonl").open("a") as file:
            file.write(json.dumps({"phase": name, **row}) + "\n")

    fit(objective, state, path, interrupt, config.save_every, evaluate, record)
    setattr(denoiser, name, state.average)
    denoiser.network_dtype = torch.float32
    return state.step


def _objective(name: str, phase: PhaseConfig, prepared: Prepared, denoiser: PersonDenoiser) -> Objective:
    if name == "local":
        return RestObjective(denoiser, prepared.train, prepared.codec, prepared.vocabulary, phase)
    coefficients = torch.cat([prepared.prior.split(chunk.float())[0] for chunk in prepared.train.latents.split(128)])
    # Components are fitted to these people and vary more over them than over new ones; the prior knows by how much.
    coefficients *= denoiser.component_std / coefficients.square().mean(0).sqrt()
    return PersonObjective(denoiser, coefficients, prepared.train, prepared.vocabulary, phase)


def _card(
    config: TrainingConfig, prepared: Prepared, denoiser: PersonDenoiser, steps: dict[str, int]
) -> dict[str, object]:
    """What the checkpoint says of itself: data, settings, and held-out errors beside the closed forms'."""
    guesses = {
        "gaussian": closed_form(denoiser, single=True),
        "mixture": closed_form(denoiser, single=False),
        "denoiser": denoiser,
    }
    errors = x0_errors(guesses, denoiser, prepared.held.latents)
    return {
        "name": "PrimDiffusion default",
        "version": __version__,
        "licence": "CC0-1.0",
        "data": "people dressed from MakeHuman's CC0 assets, in T-pose, as primitives made without a network",
        "geometries": len(prepared.train.betas),
        "people": len(prepared.train),
        "held_out_geometries": len(prepared.held.betas),
        "full_density": prepared.full_density,
        "schedule": config.schedule,
        "seed": config.seed,
        "device": "CPU",
        "torch": torch.__version__,
        "steps": steps,
        "batch": {"person": config.person.batch, "local": config.local.batch},
        "parameters": sum(
            p.numel() for part in (denoiser.person, denoiser.local) if part is not None for p in part.parameters()
        ),
        "held_out_rms_x0_error": {
            name: {str(level): round(e, 5) for level, e in by.items()} for name, by in errors.items()
        },
        "limits": list(LIMITS),
        "beats_gaussian_at_every_level": all(
            errors["denoiser"][level] < errors["gaussian"][level] for level in errors["gaussian"]
        ),
    }


def _save_state(state: TrainingState, path: Path, seconds: float) -> None:
    state.seconds += seconds
    state.save(path)


def _save_prepared(path: Path, prepared: Prepared) -> None:
    tensors = {}
    for name in ("train", "held", "codec", "prior", "shapes"):
        record = getattr(prepared, name)
        for field in dataclasses.fields(record):
            value = getattr(record, field.name)
            tensors[f"{name}.{field.name}"] = value.contiguous()
    about = {"full_density": repr(prepared.full_density), "vocabulary": json.dumps(prepared.vocabulary.to_json())}
    write_atomically(path, save(tensors, metadata=about))


def _load_prepared(path: Path) -> Prepared:
    with safe_open(path, framework="pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - safe_open is no mapping
        about = file.metadata()

    def part(name: str) -> dict[str, Tensor]:
        return {key.removeprefix(f"{name}."): value for key, value in tensors.items() if key.startswith(f"{name}.")}

    return Prepared(
        LatentSet(**part("train")),
        LatentSet(**part("held")),
        LinearCodec(**part("codec")),
        PersonPrior(**part("prior")),
        ShapePrior(**part("shapes")),
        Vocabulary.from_json(json.loads(about["vocabulary"])),
        float(about["full_density"]),
    )


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    train(tyro.cli(TrainingConfig))
