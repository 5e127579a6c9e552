"""Many people at once, small, to choose from, new ones or variants of one: `variations` of JSON-RPC."""

from __future__ import annotations

import dataclasses
import itertools
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from primdiffusion.commands.checks import check_attributes, check_picture_px, check_seed, check_steps
from primdiffusion.commands.progress import Pace, Report
from primdiffusion.editing.unit_interval import check_unit_interval
from primdiffusion.formats import requests
from primdiffusion.machine import peak_memory_gb
from primdiffusion.staging import staged

if TYPE_CHECKING:
    from torch import Tensor

    from primdiffusion.commands.session import Session
    from primdiffusion.diffusion.model import DiffusionModel
    from primdiffusion.diffusion.samplers import SamplerStep
    from primdiffusion.human import Human

MOST_VARIATIONS = 64
"""They are sampled together: memory grows with their number."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class VariationsRequest:
    """Generate people of several seeds in one batch, each with a picture."""

    seeds: list[int]
    """No two alike."""
    out_dir: Path
    """Folder for three files of each: SEED.human.npz, SEED.human.safetensors and SEED.png; made if missing."""
    steps: int = requests.STEPS
    sampler: requests.Sampler = requests.SAMPLERS[0]
    checkpoint: Path | None = None
    """Trained model (.safetensors); without it the one that comes with the package."""
    size: int = requests.VARIATION_SIZE
    """Pixels a side of the pictures."""
    attributes: dict[str, str | float] = dataclasses.field(default_factory=dict)
    guidance: float = requests.GUIDANCE
    person: Path | None = None
    """A .human.safetensors file: variants of this person, as `vary` makes them, instead of new people."""
    amount: float = requests.AMOUNT
    """How far variants of a person go, as of `vary`."""

    def check(self) -> None:
        """See `Request`."""
        if not 1 <= len(self.seeds) <= MOST_VARIATIONS:
            raise ValueError(f"{len(self.seeds)} seeds were given: choose 1 to {MOST_VARIATIONS}")
        for seed in self.seeds:
            check_seed(seed)
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError("two of the seeds are alike, which would be one person twice: give each once")
        check_steps(self.steps)
        check_picture_px(self.size)
        if self.size < 2:
            raise ValueError(f"pictures of {self.size} pixels a side: choose 2 or more")
        check_attributes(self.attributes, self.guidance)
        check_unit_interval("amount", self.amount)

    def run(self, session: Session, report: Report) -> dict[str, Any]:
        """The people of all seeds in `out_dir`, or none of them; returns their paths and what it took.

        Their pictures become clearer with the steps, as far as time allows (`Allowance`). Each picture is reported as
        it appears, with the seed's index. Raises OSError before any work if the folder cannot be written to; what
        load_checkpoint, generate_batch, load_human and vary_batch raise.
        """
        # torch is loaded late
        from primdiffusion.commands.step_pictures import draw_front_and_back
        from primdiffusion.human_file import export_for_blender, save_human

        began = time.perf_counter()
        with staged(self.out_dir) as folder:
            report("load", 0, self.steps, None)
            model = session.model(self.checkpoint)
            report("sample", 0, self.steps, None)
            for index, human in enumerate(_people(model, self, folder, report)):
                files = _files(folder, self.seeds[index])
                export_for_blender(files["human"], human)
                save_human(files["person"], human)
                draw_front_and_back(Path(files["picture"]), human, self.size)
                report("write", index + 1, len(self.seeds), None, picture=files["picture"], index=index)
        return {
            "people": [{"seed": seed, **_files(self.out_dir, seed)} for seed in self.seeds],
            "seconds": round(time.perf_counter() - began, 3),
            "peak_gb": round(peak_memory_gb(), 3),
        }


def _files(folder: Path, seed: int) -> dict[str, str]:
    endings = {"human": "human.npz", "person": "human.safetensors", "picture": "png"}
    return {name: str(folder / f"{seed}.{ending}") for name, ending in endings.items()}


def _people(model: DiffusionModel, request: VariationsRequest, folder: Path, report: Report) -> list[Human]:
    """New people, or variants of one, in one batch, with pictures of what they are so far, each in turn."""
    # torch is loaded late
    from primdiffusion.commands.step_pictures import INTERVAL_S, Allowance, PassingPictures, draw_front_and_back
    from primdiffusion.editing.edit import with_payload
    from primdiffusion.editing.vary import vary_batch
    from primdiffusion.human import generate_batch, people_of
    from primdiffusion.human_file import load_human

    seeds, person = request.seeds, None if request.person is None else load_human(request.person)
    pace, allowance, turns = Pace(), Allowance(INTERVAL_S / len(seeds)), itertools.cycle(range(len(seeds)))

    def guess(x0: Tensor, seed: int) -> Human:
        if person is None:
            return people_of(model, x0, [seed], request.attributes)[0]
        return with_payload(model, person, x0)

    def on_step(step: SamplerStep) -> None:
        done = step.index + 1
        left = pace.left(done, step.total)
        report("sample", done, step.total, left)
        for _ in seeds:
            if done == step.total or not allowance.granted():
                return
            index = next(turns)
            with allowance.spending():
                path = passing.next()
                draw_front_and_back(path, guess(step.x0[index : index + 1], seeds[index]), request.size)
            report("sample", done, step.total, left, picture=str(path), index=index)

    with PassingPictures(folder, 2 * len(seeds)) as passing:
        asked = (request.attributes, request.guidance)
        if person is None:
            return generate_batch(model, seeds, request.steps, request.sampler, on_step, *asked)
        return vary_batch(model, person, request.amount, seeds, request.steps, on_step, *asked)
