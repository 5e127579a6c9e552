"""Edit a human: `vary`, `interpolate`, `inpaint` and `transfer`, on the command line and of JSON-RPC."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from primdiffusion.commands.request import (
    Attributes,
    OutDir,
    ParameterError,
    ReportProgress,
    check_attributes,
    check_picture_px,
    check_size,
    check_steps,
    parse,
    progress_bar,
    step_reporter,
)
from primdiffusion.formats import requests
from primdiffusion.formats.requests import check_seed, check_unit_interval
from primdiffusion.formats.whole_files import staged
from primdiffusion.machine import peak_memory_gb

if TYPE_CHECKING:
    from jaxtyping import Bool
    from torch import Tensor

    from primdiffusion.commands.output import Decode
    from primdiffusion.commands.session import Session
    from primdiffusion.diffusion.model import DiffusionModel
    from primdiffusion.editing.edit import OnStep
    from primdiffusion.human import Human

    Sampling = Callable[[Decode], AbstractContextManager[OnStep]]
    """Reports the steps of a sampler, with previews of the humans that the function makes of its x0 guesses."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EditRequest:
    """Fields and steps that all edits share."""

    person: tyro.conf.Positional[Path]
    """A .human.safetensors file; it is not changed."""
    out_dir: OutDir
    """Output folder, created if missing: human.npz for Blender, person.human.safetensors, and previews."""
    steps: int = requests.STEPS
    """Sampler steps, 1 to 1000."""
    checkpoint: Path | None = None
    """Trained model (.safetensors); the default is the one in the package."""
    size: int = requests.PICTURE_SIZE
    """Width and height of the previews, pixels."""
    picture_px: tyro.conf.Suppress[int] = 0
    """Width and height of previews while sampling, pixels; 0 for none."""

    def check(self) -> None:
        """See `RequestRecord`."""
        check_steps(self.steps)
        check_size(self.size)
        check_picture_px(self.picture_px)

    def edit(self, human: Human, session: Session, sampling: Sampling) -> Human:
        """Return the edited human."""
        raise NotImplementedError

    def run(self, session: Session, report: ReportProgress) -> dict[str, Any]:
        """See `write`."""
        return self.write(session, report)[1]

    def write(self, session: Session, report: ReportProgress) -> tuple[Human, dict[str, Any]]:
        """Edit the human and write the result, all files or none; return the result and the response.

        Raises OSError first of all if the folder cannot be written to; raises as load_human, load_checkpoint and edits.
        """
        # torch is loaded late
        from primdiffusion.commands.output import FILES, write_human
        from primdiffusion.human_file import load_human

        began = time.perf_counter()
        with staged(self.out_dir) as folder:
            report("load", 0, self.steps, None)
            human = self.edit(load_human(self.person), session, functools.partial(self._sampling, report, folder))
            edited = time.perf_counter()
            report("write", self.steps, self.steps, None)
            write_human(folder, human, self.size)
            report("write", self.steps, self.steps, 0.0)  # the last chance to cancel
        seed = {name: value for name, value in vars(self).items() if name == "seed"}  # interpolations have none
        result = {
            **FILES.in_folder(self.out_dir),
            **seed,
            "steps": self.steps,
            "seconds": round(time.perf_counter() - began, 3),
            "seconds_sampling": round(edited - began, 3),
            "peak_gb": round(peak_memory_gb(), 3),
        }
        return human, result

    @contextlib.contextmanager
    def _sampling(self, report: ReportProgress, folder: Path, decode: Decode) -> Iterator[OnStep]:
        from primdiffusion.commands.output import step_previews  # torch is loaded late

        report("sample", 0, self.steps, None)
        with step_previews(folder, self.picture_px, decode) as preview:
            yield step_reporter(report, preview)


@dataclasses.dataclass(frozen=True)
class Region:
    """A region to edit: names of body parts, or a file of painted weights."""

    names: tuple[str, ...] = ()
    weights: Path | None = None

    @classmethod
    def from_json(cls, value: Any, name: str) -> Region:
        """Read a list of names, or {"weights": path}. Raises ParameterError for anything else."""
        texts = list(value.values()) if isinstance(value, dict) and list(value) == ["weights"] else value
        if not (isinstance(texts, list) and texts and all(isinstance(text, str) and text for text in texts)):
            raise ParameterError(
                f'{name} is {value!r:.80}: give a list of names of parts, or {{"weights": path of an .npz}}'
            )
        return cls(weights=Path(texts[0])) if isinstance(value, dict) else cls(tuple(texts))

    def check(self) -> None:
        """Raise ValueError unless either names or weights are given; names are validated when the request runs."""
        if bool(self.names) == (self.weights is not None):
            raise ValueError("give either --region NAME or --weights FILE")

    def primitives(self, human: Human) -> Bool[Tensor, "k"]:
        """Return the region as a mask. Raises ValueError for unknown names and unusable weights, and OSError."""
        # torch is loaded late
        from primdiffusion.editing.regions import read_weights, region_from_weights, region_of

        if self.weights is not None:
            weights = read_weights(self.weights)
            try:
                return region_from_weights(weights, body_setup=human.body_setup)
            except ValueError as error:
                raise ValueError(f"{self.weights}: {error}") from error
        return region_of(self.names, human.body_setup)


def _region_of_arguments(region: tuple[str, ...] = (), weights: Path | None = None) -> Region:
    """The region to edit; everything outside stays bit-identical.

    Args:
        region: Body parts by name, such as top, bottom, shoes, hair, left_hand (docs/design/diffusion_edits.md).
        weights: Instead of --region: an .npz with `weights`, a number from 0 to 1 for each vertex of human.npz's body.
    """
    return Region(region, weights)


RegionArgument = Annotated[Region, tyro.conf.arg(constructor=_region_of_arguments, name="")]
"""--region and --weights on the command line."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class VaryRequest(EditRequest):
    """Generate a variant of a human: the same body with other clothes and another face."""

    amount: float = requests.AMOUNT
    """0 changes nothing; 1 leaves hardly anything in common."""
    seed: int = 0
    """Selects the variant."""
    attributes: Attributes = dataclasses.field(default_factory=dict)
    """Attributes of the variant, NAME=VALUE; `info` lists the names and values that a checkpoint knows."""
    guidance: float = requests.GUIDANCE
    """How closely attributes are followed; 1 is plain conditioning, more costs variety."""

    def check(self) -> None:
        """See `RequestRecord`."""
        super().check()
        check_unit_interval("amount", self.amount)
        check_seed(self.seed)
        check_attributes(self.attributes, self.guidance)

    def edit(self, human: Human, session: Session, sampling: Sampling) -> Human:
        """See `editing.vary`."""
        # torch is loaded late
        from primdiffusion.editing.edit import with_payload
        from primdiffusion.editing.vary import vary

        model = session.model(self.checkpoint)
        with sampling(lambda x0: with_payload(model, human, x0)) as on_step:
            return vary(model, human, self.amount, self.seed, self.steps, on_step, self.attributes, self.guidance)


@dataclasses.dataclass(frozen=True, kw_only=True)
class InterpolateRequest(EditRequest):
    """Interpolate between two humans: plausible at every fraction, with a body in between."""

    other: tyro.conf.Positional[Path]
    """A second .human.safetensors file."""
    fraction: float = requests.FRACTION
    """0 is exactly the first human, 1 exactly the second."""

    def check(self) -> None:
        """See `RequestRecord`."""
        super().check()
        check_unit_interval("fraction", self.fraction)
        if self.steps < 2:
            raise ValueError(f"{self.steps} steps were requested: interpolation takes 2 or more")

    def edit(self, human: Human, session: Session, sampling: Sampling) -> Human:
        """See `editing.interpolate`."""
        # torch is loaded late
        from primdiffusion.editing.edit import with_payload
        from primdiffusion.editing.interpolate import interpolate
        from primdiffusion.human_file import load_human

        other = load_human(self.other)
        model = session.model(self.checkpoint)

        def decode(x0: Tensor) -> Human | None:
            denoising = len(x0) == 3  # both ends and the human in between; only the two ends while inverting
            return with_payload(model, human, x0[2:]) if denoising else None

        with sampling(decode) as on_step:
            return interpolate(model, human, other, self.fraction, self.steps, on_step)


@dataclasses.dataclass(frozen=True, kw_only=True)
class InpaintRequest(EditRequest):
    """Resample a region of a human so that it fits the rest, for other clothes or hair."""

    region: RegionArgument
    seed: int = 0
    """Selects one of the possible results."""
    attributes: Attributes = dataclasses.field(default_factory=dict)
    """Attributes of the region, NAME=VALUE as in outfit=suit; `info` lists those that a checkpoint knows."""
    guidance: float = requests.GUIDANCE
    """How closely attributes are followed; 1 is plain conditioning, more costs variety."""
    masking: requests.Masking = requests.MASKINGS[0]
    """repaint: the rest is noised to each step's own level, and each step is sampled twice; released: as in the
    authors' code, the rest is pasted one level too noisy, and each step is sampled once."""

    def check(self) -> None:
        """See `RequestRecord`."""
        super().check()
        self.region.check()
        check_seed(self.seed)
        check_attributes(self.attributes, self.guidance)

    def edit(self, human: Human, session: Session, sampling: Sampling) -> Human:
        """See `editing.inpaint`."""
        from primdiffusion.editing.inpaint import inpaint  # torch is loaded late

        region = self.region.primitives(human)
        model = session.model(self.checkpoint)
        with sampling(lambda x0: _decode_inside(model, human, region, x0)) as on_step:
            return inpaint(
                model, human, region, self.seed, self.steps, self.attributes, self.guidance, on_step, self.masking
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class TransferRequest(EditRequest):
    """Copy the appearance of a region from another human. Checkpoint, seed and steps apply to harmonising."""

    source: Path
    """A .human.safetensors file to copy from."""
    region: RegionArgument
    what: requests.Transfer = requests.TRANSFERS[0]
    """texture: colours only, for garments of the same cut; garment: shape too."""
    harmonise: float = 0.0
    """0 copies exactly; up to 1, how much the region is then denoised to fit the rest."""
    seed: int = 0
    """Selects one of the possible results."""

    def check(self) -> None:
        """See `RequestRecord`."""
        super().check()
        self.region.check()
        check_unit_interval("harmonise", self.harmonise)
        check_seed(self.seed)

    def edit(self, human: Human, session: Session, sampling: Sampling) -> Human:
        """See `editing.transfer`. Loads a model only for harmonising."""
        # torch is loaded late
        from primdiffusion.editing.inpaint import harmonise
        from primdiffusion.editing.transfer import transfer_garment, transfer_texture
        from primdiffusion.human_file import load_human

        source, region = load_human(self.source), self.region.primitives(human)
        edited = (transfer_garment if self.what == "garment" else transfer_texture)(source, human, region)
        if not self.harmonise:
            return edited
        model = session.model(self.checkpoint)
        with sampling(lambda x0: _decode_inside(model, edited, region, x0)) as on_step:
            return harmonise(model, edited, region, self.harmonise, self.seed, self.steps, on_step)


def _decode_inside(model: DiffusionModel, human: Human, region: Bool[Tensor, "k"], x0: Tensor) -> Human:
    """Return the human with a sampler's x0 guess decoded inside a region."""
    from primdiffusion.editing.edit import combined, with_payload  # torch is loaded late

    guess = with_payload(model, human, x0)
    return dataclasses.replace(guess, payload=combined(region, guess.payload, human.payload))


def _run(record: type[EditRequest], command: str, arguments: Sequence[str]) -> None:
    """Run a command line and print the output folder; raises its errors."""
    request = parse(record, arguments, command)
    from primdiffusion.commands.session import Session  # loads torch, which --help does not need

    with progress_bar() as report:
        human, result = request.write(Session(), report)
    print(f"{request.out_dir}  {human.provenance['edits'][-1]['edit']}, {result['seconds']:.1f} s")


run_vary = functools.partial(_run, VaryRequest, "vary")
run_interpolate = functools.partial(_run, InterpolateRequest, "interpolate")
run_inpaint = functools.partial(_run, InpaintRequest, "inpaint")
run_transfer = functools.partial(_run, TransferRequest, "transfer")
