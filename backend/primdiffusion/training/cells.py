"""The preset `default`: a closed-form person prior on latents of cells, corrected by a light network."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.diffusion.codec import CellCodec, LinearCodec
from primdiffusion.diffusion.conditioning import AttributeVocabulary
from primdiffusion.diffusion.denoiser import PersonDenoiser
from primdiffusion.diffusion.gaussian import PersonPrior
from primdiffusion.diffusion.model import DiffusionModel, ShapePrior
from primdiffusion.diffusion.schedule import early_steps, fine_linear
from primdiffusion.diffusion.surfaces import Surfaces
from primdiffusion.files import tensor_file
from primdiffusion.files.json_files import parse_json
from primdiffusion.files.regular_files import as_file_error
from primdiffusion.files.whole_files import write_atomically
from primdiffusion.people.stored_people import PersonFolder, one_density
from primdiffusion.runtime.device import has_fast_bfloat16
from primdiffusion.training.colour_pairs import with_colour_pairs
from primdiffusion.training.config import NetworkTraining, PriorConfig, TrainingConfig
from primdiffusion.training.diffusion_task import DiffusionTask
from primdiffusion.training.latents import LatentSet, encode_people, fit_codec_to, vocabulary_of
from primdiffusion.training.loop import TrainingStep
from primdiffusion.training.losses import RestObjective, closed_form, x0_errors
from primdiffusion.training.prior import fit_prior, fit_shapes
from primdiffusion.training.surfaces import fit_surfaces

PREPARED = "prepared.safetensors"


@dataclasses.dataclass(frozen=True)
class Prepared:
    """Closed-form parts of a run, computed before training."""

    train: LatentSet
    held: LatentSet
    codec: LinearCodec
    prior: PersonPrior
    shapes: ShapePrior
    surfaces: Surfaces | None
    vocabulary: AttributeVocabulary
    full_density: float


def prepare(
    config: TrainingConfig,
    people: PersonFolder,
    train: Sequence[int],
    held: Sequence[int],
    base: DiffusionModel | None = None,
) -> Prepared:
    """Return codec, latents, prior, shapes and surfaces of a run; loaded from the run folder if they are saved there.

    With a `base` (`load_base`) all but the latents are those of that model.

    Raises ValueError for a person's file, or prepared ones, that are damaged, for people of another full density than
    the others or those of `base`, and for too few people; OSError.
    """
    path = config.run / PREPARED
    if path.exists():
        return _load_prepared(path)
    one_density([each.full_density for each in (people, base) if each is not None])
    if base is not None:
        prepared = _prepared_with(base, people, train, held)
        _save_prepared(path, prepared)
        return prepared
    _check_enough([people.variants[index] for index in train], config.prior)
    generator = torch.Generator().manual_seed(config.seed)
    vocabulary = vocabulary_of(each for index in train for each in people.known(index))
    codec = fit_codec_to(people, train, config.codec, generator)
    latents, unseen = (encode_people(people, indices, codec, vocabulary) for indices in (train, held))
    prior = fit_prior(latents, codec, vocabulary, config.prior)
    shapes = fit_shapes(latents, prior)
    surfaces = fit_surfaces(latents, codec, vocabulary, config.prior)
    if surfaces is not None:
        surfaces = with_colour_pairs(surfaces, latents, codec, prior, generator)
    prepared = Prepared(latents, unseen, codec, prior, shapes, surfaces, vocabulary, people.full_density)
    _save_prepared(path, prepared)
    return prepared


def _check_enough(samples: Sequence[int], config: PriorConfig) -> None:
    """Raise ValueError for people, of so many samples each, whose variance the components would explain to the last.

    Without a rest in each fold there is nothing to compare that of new people with.
    """
    fitted = min(sum(samples) - sum(samples[fold :: config.folds]) for fold in range(config.folds))
    if config.components >= 2 * fitted - 1:  # components of even and of odd parts
        raise ValueError(
            f"{len(samples)} humans with {sum(samples)} colourings are too few to train {config.components} person "
            "components on: make more with primdiffusion payloads, or give a smaller --prior.components"
        )


def load_base(path: Path) -> DiffusionModel:
    """Load a checkpoint to go on from. Raises ValueError unless it is of the default preset; FileNotFoundError."""
    model = load_checkpoint(path)
    if not isinstance(model.denoiser, PersonDenoiser) or model.denoiser.local is None:
        raise ValueError(f"{path} is not a checkpoint of the default preset: give another --start-from")
    return model


def _prepared_with(base: DiffusionModel, people: PersonFolder, train: Sequence[int], held: Sequence[int]) -> Prepared:
    assert isinstance(base.codec, CellCodec)
    assert isinstance(base.denoiser, PersonDenoiser)
    codec, vocabulary = base.codec.codec, base.vocabulary
    latents, unseen = (encode_people(people, indices, codec, vocabulary) for indices in (train, held))
    return Prepared(
        latents, unseen, codec, base.denoiser.prior, base.shapes, base.surfaces, vocabulary, people.full_density
    )


class CellTask(DiffusionTask):
    """Trains the network of a `PersonDenoiser`, which starts with the weights of `base` if it is given."""

    name = "local"

    def __init__(
        self, config: TrainingConfig, prepared: Prepared, device: torch.device, base: DiffusionModel | None = None
    ) -> None:
        torch.manual_seed(config.seed)
        self.config, self.device = config, device
        self.codec, self.shapes = prepared.codec.to(device), prepared.shapes.to(device)
        self.surfaces = None if prepared.surfaces is None else prepared.surfaces.to(device)
        self.train, self.held = prepared.train.to(device), prepared.held.to(device)
        self.vocabulary, self.full_density = prepared.vocabulary, prepared.full_density
        schedule = fine_linear()
        if base is None:
            self.denoiser = PersonDenoiser(config.model, prepared.prior, schedule)
        else:
            assert isinstance(base.denoiser, PersonDenoiser)  # as `load_base` has checked
            self.denoiser = PersonDenoiser(base.denoiser.config, prepared.prior, schedule)
            self.denoiser.load_state_dict(base.denoiser.state_dict())
        self.denoiser.eval().requires_grad_(False).to(device)
        self.objective = RestObjective(self.denoiser, self.train, self.codec, self.vocabulary, config.local)

    @property
    def settings(self) -> NetworkTraining:
        """Return the settings of the network."""
        return self.config.local

    def network(self) -> nn.Module:
        """Return the network."""
        assert self.denoiser.local is not None
        return self.denoiser.local

    def use_network(self, network: nn.Module) -> None:
        """Install a network, in the precision of its settings."""
        self.denoiser.local = network
        fast = self.settings.bfloat16 and has_fast_bfloat16(self.device)
        self.denoiser.network_dtype = torch.bfloat16 if fast else torch.float32

    def loss(self, step: TrainingStep) -> Mapping[str, Tensor]:
        """Weighted x0 error of a random batch at random levels."""
        return {"loss": self.objective.loss(step.generator)}

    def errors(self) -> Mapping[int, float]:
        """RMS x0 errors on the held-out set, in units of latents."""
        return x0_errors({"rms": self.denoiser}, self.denoiser.schedule, self.held.latents)["rms"]

    def errors_beside_closed_forms(self) -> dict[str, dict[int, float]]:
        """Same as `errors`, also for the prior as a single Gaussian and as a mixture, on the same noise."""
        guesses = {
            "gaussian": closed_form(self.denoiser, single=True),
            "mixture": closed_form(self.denoiser, single=False),
            "denoiser": self.denoiser,
        }
        return x0_errors(guesses, self.denoiser.schedule, self.held.latents)

    def model(self) -> DiffusionModel:
        """Return the model with the installed network, without a card."""
        codec, denoiser = CellCodec(self.codec), self.denoiser
        return DiffusionModel(
            denoiser, denoiser.schedule, codec, self.shapes, self.full_density, {}, self.vocabulary,
            early_steps, surfaces=self.surfaces,
        )  # fmt: skip


def _save_prepared(path: Path, prepared: Prepared) -> None:
    tensors = {}
    for name in ("train", "held", "codec", "prior", "shapes", "surfaces"):
        record = getattr(prepared, name)
        for field in () if record is None else dataclasses.fields(record):
            value = getattr(record, field.name)
            tensors[f"{name}.{field.name}"] = value.contiguous()
    about = {"full_density": repr(prepared.full_density), "vocabulary": json.dumps(prepared.vocabulary.to_json())}
    write_atomically(path, tensor_file.save(tensors, metadata=about))


def _load_prepared(path: Path) -> Prepared:
    with as_file_error(path, "is damaged", "remove it to compute it again"):
        tensors, about = tensor_file.read(path)

        def part(name: str) -> dict[str, Tensor]:
            return {key.removeprefix(f"{name}."): value for key, value in tensors.items() if key.startswith(f"{name}.")}

        return Prepared(
            LatentSet(**part("train")),
            LatentSet(**part("held")),
            LinearCodec(**part("codec")),
            PersonPrior(**part("prior")),
            ShapePrior(**part("shapes")),
            Surfaces(**part("surfaces")) if part("surfaces") else None,
            AttributeVocabulary.from_json(parse_json(about["vocabulary"])),
            float(about["full_density"]),
        )
