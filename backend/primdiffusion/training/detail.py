"""Train a detail decoder for a diffusion model. `primdiffusion train-detail --help`.

Two sets of payloads of the same humans are given: those that the model learned from (`--coarse`; `payloads --making
from_mesh`), and finer ones (`--data`; `payloads`). The decoder learns to predict the finer ones from latents of the
coarse ones, also from the model's own guesses of these at several noise levels, which are what it meets in generation.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import tyro
from accelerate import PartialState
from torch import Tensor, nn

from primdiffusion.diffusion.checkpoint import load_checkpoint, save_checkpoint
from primdiffusion.diffusion.codec import CellCodec, LinearCodec
from primdiffusion.diffusion.detail import DetailCodec, DetailConfig, DetailDecoder, FineCodec
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.diffusion.schedule import schedule_name
from primdiffusion.primitives.anchors import CHARTS, default_anchors
from primdiffusion.primitives.primitives import GRID
from primdiffusion.training.config import CodecConfig, PhaseConfig, RunSettings
from primdiffusion.training.detail_latents import NOISE_LEVELS, PREPARED, PreparedDetail, prepare
from primdiffusion.training.latents import split_people
from primdiffusion.training.phase import state_path, train_phase
from primdiffusion.training.recorder import Interrupt
from primdiffusion.training.run_folder import alone, begin
from primdiffusion.training.shards import open_people
from primdiffusion.training.state import AcceleratedState, accelerator_of
from primdiffusion.training.stored_people import PersonDataset
from primdiffusion.training.trackers import check_tracker, tracking

PHASE = "detail"
MODEL = "model.safetensors"
HEAD_WEIGHT = 3.0
"""Weight of the head's cells in the loss; eyes look at faces first."""
CODEC_LIMIT = "the codec keeps"
DETAIL_LIMIT = (
    "A voxel is 6 to 17 mm wide, and detail that the latents do not hold is the decoder's guess from the rest: prints "
    "and fine stripes are soft, and faces are more alike than in the data."
)


@dataclasses.dataclass(frozen=True)
class DetailTrainingConfig(RunSettings):
    """Train a decoder that adds detail to a model's humans; the same command line resumes."""

    data: Path
    """The finer payloads: a folder of `primdiffusion payloads`, or of its shards."""
    coarse: Path
    """Payloads of the same humans, as the model learned them: `payloads --making from_mesh`."""
    run: Path
    """Folder of the run: weights, metrics, images and settings; an unfinished run is resumed."""
    checkpoint: Path | None = None
    """The model, of preset default; without it the package's. A detail decoder that it has is replaced."""
    codec: CodecConfig = dataclasses.field(default_factory=CodecConfig)
    """The finer codec."""
    model: DetailConfig = dataclasses.field(default_factory=DetailConfig)
    detail: PhaseConfig = dataclasses.field(
        default_factory=lambda: PhaseConfig(steps=6000, batch=16, learning_rate=1.5e-3, blend=0.5)
    )
    """Training of the decoder. Levels, weighting and attributes do not apply."""


@alone
def train_detail(config: DetailTrainingConfig) -> DiffusionModel:
    """Run or resume a training run; returns the model with the decoder, which is also in run/model.safetensors.

    Raises:
        ValueError: the model diffuses slabs; the two sets hold different humans or colourings; otherwise as
            `train`.
        FileNotFoundError: there are fewer than two people, or no checkpoint.
        OSError: the disk is full; the last saved state remains.
    """
    if config.threads:
        torch.set_num_threads(config.threads)
    check_tracker(config.tracker)
    accelerator = accelerator_of()
    base = load_checkpoint(config.checkpoint, accelerator.device)
    if not isinstance(base.codec, CellCodec):
        raise ValueError(f"{config.checkpoint} diffuses slabs, not latents of cells: give a model of preset default")
    coarse_codec = base.codec.codec
    fine, coarse = open_people(config.data), open_people(config.coarse)
    _check_same(config, fine, coarse)
    chosen, held = split_people(range(len(fine.names)), config.holdout, config.seed)
    with accelerator.main_process_first():
        if accelerator.is_main_process:
            done = AcceleratedState.saved_step(state_path(config, PHASE))
            about = {"held": [fine.names[index] for index in held]}
            begin(
                config, fine.names, about, {"step": done, "processes": accelerator.num_processes},
                lambda row: row["step"] <= done,
            )  # fmt: skip
        prepared = prepare(
            config.run / PREPARED, base, coarse_codec, fine, coarse, (chosen, held), config.codec, config.seed
        )
    trainee = DetailTrainee(config, base, coarse_codec, fine.full_density, prepared)
    tracker = config.tracker if accelerator.is_main_process else None
    with Interrupt(config.minutes) as interrupt, tracking(tracker, config.run) as tracked:
        state = train_phase(config, trainee, PHASE, accelerator, interrupt, tracked)
    model = trainee.model()
    if accelerator.is_main_process:
        model = dataclasses.replace(model, card=_card(base.card, fine, chosen, held, trainee, state))
        save_checkpoint(config.run / MODEL, model, schedule_name(base.schedule))
    accelerator.end_training()
    return model


class DetailTrainee:
    """Trains a `DetailDecoder` by the square error of fine latents, whose units are those of the marcher's window."""

    def __init__(
        self,
        config: DetailTrainingConfig,
        base: DiffusionModel,
        coarse_codec: LinearCodec,
        full_density: float,
        prepared: PreparedDetail,
    ) -> None:
        torch.manual_seed(config.seed)
        self.base, self.coarse_codec, self.full_density = base, coarse_codec, full_density
        self.prepared, self.device = prepared, base.device
        self.phases: Mapping[str, PhaseConfig] = {PHASE: config.detail}
        channels, fine_channels = prepared.forward.shape[1], prepared.forward.shape[0]
        decoder = DetailDecoder(channels, fine_channels, config.model)
        with torch.no_grad():
            decoder.linear.weight.copy_(prepared.forward[:, :, None, None])
            decoder.latent_std.copy_(prepared.latent_std)
            decoder.rest_std.copy_(prepared.rest_std)
        self.decoder: nn.Module = decoder.eval().requires_grad_(False).to(self.device)
        head = default_anchors().chart == CHARTS.index("head")
        weight = torch.where(head, HEAD_WEIGHT, 1.0).unflatten(0, (GRID, GRID))
        self.weight = (weight / weight.mean()).to(self.device)
        self.start = torch.searchsorted(prepared.train.geometry, torch.arange(int(prepared.train.geometry.max()) + 2))

    def network(self, name: str) -> nn.Module:
        """The decoder."""
        return self.decoder

    def put(self, name: str, network: nn.Module) -> None:
        """Install the decoder, or its average."""
        self.decoder = network

    def loss(self, name: str, generator: torch.Generator) -> Tensor:
        """Square error of a random batch, relative to that of the linear map: blends of two colourings of a geometry,
        half of them mirrored."""
        phase, known = self.phases[name], self.prepared.train
        count, draw = phase.batch, torch.Generator().manual_seed(generator.initial_seed())
        first = torch.randint(len(known.fine), (count,), generator=draw)
        low, high = self.start[known.geometry[first]], self.start[known.geometry[first] + 1]
        other = low + (torch.rand(count, generator=draw) * (high - low)).long()
        level = torch.randint(known.coarse.shape[1], (count,), generator=draw)
        share = torch.rand(count, generator=draw) * (torch.rand(count, generator=draw) < phase.blend)
        mirrored = (torch.rand(count, generator=draw) < 0.5)[:, None, None, None]
        coarse, fine = (
            torch.lerp(one.float(), two.float(), share[:, None, None, None])
            for one, two in (
                (known.coarse[first, level], known.coarse[other, level]),
                (known.fine[first], known.fine[other]),
            )
        )
        coarse = torch.where(mirrored, self.coarse_codec.to("cpu").mirror(coarse), coarse)
        fine = torch.where(mirrored, self.prepared.codec.mirror(fine), fine)
        error = self.decoder(coarse.to(self.device)) - fine.to(self.device)
        return (error.square().mean(1) * self.weight).mean() / self.prepared.rest_std.square().mean().to(self.device)

    def errors(self) -> Mapping[int, float]:
        """RMS error of held-out fine latents, from guesses at each noise level; 0 is clean latents."""
        return self._errors(self.decoder)

    def linear_errors(self) -> Mapping[int, float]:
        """As `errors`, of the linear map alone."""
        forward = self.prepared.forward.to(self.device)
        return self._errors(lambda coarse: torch.einsum("dc,nchw->ndhw", forward, coarse))

    def model(self) -> DiffusionModel:
        """Return the model with the installed decoder, without a card."""
        assert isinstance(self.decoder, DetailDecoder), "models are taken of the average, which no process group wraps"
        fine = FineCodec(self.prepared.codec, self.prepared.back).to(self.device)
        codec = DetailCodec(self.coarse_codec.to(self.device), fine, self.decoder)
        return dataclasses.replace(self.base, codec=codec, full_density=self.full_density, card={})

    @torch.no_grad()
    def _errors(self, decoder: Callable[[Tensor], Tensor]) -> dict[int, float]:
        held, errors = self.prepared.held, {}
        for number, level in enumerate((0, *NOISE_LEVELS)):
            squares = [
                (decoder(coarse.float().to(self.device)) - fine.float().to(self.device)).square().mean((1, 2, 3))
                for coarse, fine in zip(held.coarse[:, number].split(16), held.fine.split(16), strict=True)
            ]
            errors[level] = float(torch.cat(squares).mean().sqrt())
        return errors


def _check_same(config: DetailTrainingConfig, fine: PersonDataset, coarse: PersonDataset) -> None:
    """Raise ValueError unless both sets hold the same humans in as many colourings."""
    if list(fine.names) != list(coarse.names) or list(fine.variants) != list(coarse.variants):
        raise ValueError(
            f"{config.data} holds {len(fine.names)} humans with {sum(fine.variants)} colourings, {config.coarse} "
            f"{len(coarse.names)} with {sum(coarse.variants)}, or under other names: make both with the same seeds and "
            "--variants"
        )


def _card(
    base: Mapping[str, Any],
    fine: PersonDataset,
    chosen: Sequence[int],
    held: Sequence[int],
    trainee: DetailTrainee,
    state: AcceleratedState,
) -> dict[str, Any]:
    """The model's card, with the decoder's data, training and held-out errors."""
    detail = {
        "geometries": len(chosen),
        "people": sum(fine.variants[index] for index in chosen),
        "held out geometries": len(held),
        "steps": state.step,
        "seconds": round(state.seconds, 1),
        "batch": trainee.phases[PHASE].batch * state.accelerator.num_processes,
        "parameters": sum(parameter.numel() for parameter in state.network.parameters()),
    }
    errors = {"linear": trainee.linear_errors(), "decoder": trainee.errors()}
    limits = [limit for limit in base.get("limits", ()) if CODEC_LIMIT not in limit and limit != DETAIL_LIMIT]
    return {
        **base,
        "full_density": fine.full_density,
        "detail_decoder": detail,
        "held_out_rms_detail_error": {
            name: {str(level): round(error, 5) for level, error in by.items()} for name, by in errors.items()
        },
        **({"limits": [*limits, DETAIL_LIMIT]} if limits else {}),
    }


def run(arguments: Sequence[str] | None = None) -> None:
    """Parse a command line, train, and print the path of the model. Raises as `train_detail` does."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    config = tyro.cli(DetailTrainingConfig, args=arguments, prog="primdiffusion train-detail")
    model = train_detail(config)
    if PartialState().is_main_process:
        print(f"{config.run / MODEL}  steps: {model.card['detail_decoder']['steps']}")
