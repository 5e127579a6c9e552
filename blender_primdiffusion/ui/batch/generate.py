"""`blender -c primdiffusion generate`: humans in folders, without a window.

OUT/settings.json, report.json
OUT/person_000007/person.human.safetensors, front.png, side.png, depth.png
OUT/person_000007/person.blend      where asked for
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

from ...backend.requests import Backend, ChildRequest
from ...console import Report, Stop, duration
from ...formats.regular_files import check_unlinked, real_path
from ...jobs.queue import chosen_checkpoint
from ...scene.payload import PERSON_FILE
from ..attributes import Attributes, parsed
from .arguments import DECLARED, motion_name, parse_generate
from .people import Movement, movement_of, person_blend
from .running import Clock, Say, ask, attempt, backend_of, begun, publish, run, staging

SETTINGS = "settings.json"
"""The settings of a folder's humans."""
_PRINT_S = 2.0
"""Between lines of progress."""


def main(argv: Sequence[str]) -> int:
    """The command with its words; returns the exit code."""
    return run("generate", argv, parse_generate, _generate)


def _generate(options: argparse.Namespace, say: Say, stop: Stop) -> Report:
    attributes, movement = parsed(", ".join(options.attributes)), None
    if options.blend is not None:
        movement = movement_of(options)
    params = _params(options, attributes)
    report, clock = Report(), Clock(options.count)
    settings = {**params, "motion": motion_name(options)}
    with begun(report, options.out / SETTINGS, settings, options.resume), backend_of(options.python) as backend:
        for number in range(options.count):
            seed = options.seed + number
            which = f"{number + 1}/{options.count}"
            job = _Person(options, {**params, "seed": seed}, movement, which, say, stop)
            attempt(job.name, "generate", lambda job=job: job.make(backend), report, clock, stop, say, which)
    return report


def person_name(seed: int) -> str:
    """Name of the folder for a seed."""
    return f"person_{seed:06d}"


def _params(options: argparse.Namespace, attributes: Attributes) -> dict[str, object]:
    """Parameters of the child's method that all humans share."""
    checkpoint = real_path(options.checkpoint) if options.checkpoint is not None else chosen_checkpoint("checkpoint")
    params = {field: getattr(options, field) for field in DECLARED}
    if attributes:
        params["attributes"] = attributes
    return {**params, **({"checkpoint": str(checkpoint)} if checkpoint else {})}


class _Person:
    """One of the batch."""

    def __init__(self, options, params, movement: Movement | None, which: str, say: Say, stop: Stop):
        self.name = person_name(params["seed"])
        self.say, self.which = say, which
        self._folder: Path = options.out / self.name
        self._blend, self._params, self._movement, self._stop = options.blend, params, movement, stop
        self._printed = 0.0

    def make(self, backend: Backend) -> bool:
        """Write the folder, then the .blend; what is there already stays. Raises as `ask`, and ValueError and OSError.

        Where the .blend cannot be made the human stays. Returns whether anything was missing.
        """
        if all((self._folder / name).is_file() for name in (PERSON_FILE, self._blend) if name is not None):
            return False
        check_unlinked(self._folder)
        if not (self._folder / PERSON_FILE).is_file():
            with staging(self._folder) as made:
                asked = {**self._params, "out_dir": str(made)}
                answer = ask(backend, "generate", asked, self._stop, self._print_progress)
                for warning in answer.warnings:
                    self.say(f"{self.which} {self.name}: {warning}")
                publish(made, self._folder, last=PERSON_FILE)
        if self._blend is not None:
            with staging(self._folder) as made:
                person_blend(self._folder / PERSON_FILE, made / self._blend, self.name, self._movement)
                publish(made, self._folder, last=self._blend)
        return True

    def _print_progress(self, request: ChildRequest) -> None:
        if not request.finished and time.monotonic() - self._printed > _PRINT_S:
            self._printed = time.monotonic()
            left = f" ({duration(request.eta_s)} left)" if request.eta_s else ""
            self.say(f"{self.which} {self.name}: {request.message}{left}")
