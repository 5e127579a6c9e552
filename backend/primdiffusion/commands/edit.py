"""What the requests that make a person of a person share: vary, interpolate, inpaint, transfer."""

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

from primdiffusion.commands.checks import check_picture_px, check_size, check_steps
from primdiffusion.commands.progress import Report, progress_bar, step_reporter
from primdiffusion.commands.request import OutDir, RequestError, parse
from primdiffusion.formats import requests

if TYPE_CHECKING:
    from jaxtyping import Bool
    from torch import Tensor

    from primdiffusion.commands.session import Session
    from primdiffusion.commands.step_pictures import Show
    from primdiffusion.diffusion.model import DiffusionModel
    from primdiffusion.editing.edit import OnStep
    from primdiffusion.human import Human

    Sampling = Callable[[Show], AbstractContextManager[OnStep]]
    """Reports the steps of a sampler, with pictures of what `show` makes of its guesses."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EditRequest:
    """What all of them ask for."""

    person: tyro.conf.Positional[Path]
    """A .human.safetensors file; it stays as it is."""
    out_dir: OutDir
    """Folder to write to, made if missing: human.npz for Blender, person.human.safetensors to keep, and pictures."""
    steps: int = requests.STEPS
    """Sampler steps, 1 to 1000."""
    checkpoint: Path | None = None
    """Trained model (.safetensors); without it the one that comes with the package."""
    size: int = requests.PICTURE_SIZE
    """Pixels a side of the pictures."""
    picture_px: tyro.conf.Suppress[int] = 0
    """Pixels a side of the pictures while the person is sampled; 0 for none."""

    def check(self) -> None:
        """See `Request`."""
        check_steps(self.steps)
        check_size(self.size)
        check_picture_px(self.picture_px)

    def edit(self, human: Human, session: Session, sampling: Sampling) -> Human:
        """The person made of `human`."""
        raise NotImplementedError

    def run(self, session: Session, report: Report) -> dict[str, Any]:
        """See `write`."""
        return self.write(session, report)[1]

    def write(self, session: Session, report: Report) -> tuple[Human, dict[str, Any]]:
        """Edits the person and writes the result, all files or none; the person made, and the request's result.

        Raises OSError before any work if the folder cannot be written to; what load_human, load_checkpoint and edits
        raise.
        """
        # torch is loaded late
        from primdiffusion.human_file import load_human
        from primdiffusion.machine import peak_memory_gb
        from primdiffusion.person_folder import FILES, write_person
        from primdiffusion.staging import staged

        began = time.perf_counter()
        with staged(self.out_dir) as folder:
            report("load", 0, self.steps, None)
            human = self.edit(load_human(self.person), session, functools.partial(_sampling, self, report, folder))
            edited = time.perf_counter()
            report("write", self.steps, self.steps, None)
            write_person(folder, human, self.size)
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
def _sampling(request: EditRequest, report: Report, folder: Path, show: Show) -> Iterator[OnStep]:
    from primdiffusion.commands.step_pictures import step_pictures  # torch is loaded late

    report("sample", 0, request.steps, None)
    with step_pictures(folder, request.picture_px, show) as picture:
        yield step_reporter(report, picture)


@dataclasses.dataclass(frozen=True)
class Region:
    """Where to edit: parts of the body by name, or a file of painted weights."""

    names: tuple[str, ...] = ()
    weights: Path | None = None

    @classmethod
    def from_json(cls, value: Any, name: str) -> Region:
        """Of a list of names, or of {"weights": path}. Raises RequestError for anything else."""
        texts = list(value.values()) if isinstance(value, dict) and list(value) == ["weights"] else value
        if not (isinstance(texts, list) and texts and all(isinstance(text, str) and text for text in texts)):
            raise RequestError(
                f'{name} is {value!r:.80}: give a list of names of parts, or {{"weights": path of an .npz}}'
            )
        return cls(weights=Path(texts[0])) if isinstance(value, dict) else cls(tuple(texts))

    def check(self) -> None:
        """ValueError unless just one of names and weights says where; which names there are is known later."""
        if bool(self.names) == (self.weights is not None):
            raise ValueError("say where to edit with either --region NAME or --weights FILE")

    def primitives(self, human: Human) -> Bool[Tensor, "k"]:
        """Which primitives are inside. Raises ValueError for unknown names, and as `read_weights`."""
        # torch is loaded late
        from primdiffusion.editing.painted import read_weights
        from primdiffusion.editing.regions import region_from_weights, region_of

        if self.weights is not None:
            return region_from_weights(read_weights(self.weights), body_setup=human.body_setup)
        return region_of(self.names, human.body_setup)


def _region_of_arguments(region: tuple[str, ...] = (), weights: Path | None = None) -> Region:
    """Where to edit; outside it not a bit changes.

    Args:
        region: Parts of the body by name, such as top, bottom, shoes, hair, left_hand (docs/design/diffusion_edits.md).
        weights: Instead of --region: an .npz with `weights`, a number from 0 to 1 for each vertex of human.npz's body.
    """
    return Region(region, weights)


RegionArgument = Annotated[Region, tyro.conf.arg(constructor=_region_of_arguments, name="")]
"""--region and --weights on the command line."""


def guess_inside(model: DiffusionModel, human: Human, region: Bool[Tensor, "k"], x0: Tensor) -> Human:
    """The person with what a sampler's guess stands for in a region."""
    from primdiffusion.editing.edit import combined, with_payload  # torch is loaded late

    guess = with_payload(model, human, x0)
    return dataclasses.replace(guess, payload=combined(region, guess.payload, human.payload))


def run_edit(record: type[EditRequest], arguments: Sequence[str], command: str) -> None:
    """One command line, errors as exceptions; prints the folder."""
    request = parse(record, arguments, command)
    from primdiffusion.commands.session import Session  # loads torch, which --help does not need

    with progress_bar() as report:
        human, result = request.write(Session(), report)
    print(f"{request.out_dir}  {human.provenance['edits'][-1]['edit']}, {result['seconds']:.1f} s")
