"""Metrics of a run in TensorBoard or Weights & Biases, through accelerate's trackers."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path

from accelerate.tracking import GeneralTracker, TensorBoardTracker, WandBTracker

from primdiffusion.failures import optional_package
from primdiffusion.training.config import Tracker

PROJECT = "primdiffusion"
EXTRA = "tracking"
"""Of pyproject.toml, with both packages."""


@dataclasses.dataclass(frozen=True)
class RunTracker:
    """Sends lines of metrics.jsonl to a tracker as well."""

    tracker: GeneralTracker

    def log(self, row: Mapping[str, float | str], step: int) -> None:
        """Send the numbers of a row, named PHASE/NAME if it has a phase; `step` rises over all phases of a run."""
        prefix = f"{row['phase']}/" if "phase" in row else ""
        self.tracker.log({prefix + name: value for name, value in row.items() if not isinstance(value, str)}, step=step)


def check_tracker(name: Tracker | None) -> None:
    """Raise MissingPackageError if the package of the named tracker is not installed."""
    if name is not None:
        optional_package(name, EXTRA)


@contextlib.contextmanager
def tracking(name: Tracker | None, run: Path) -> Iterator[RunTracker | None]:
    """Open the named tracker for a run folder, in the main process alone; yields None without a name.

    TensorBoard's events are in run/tensorboard. Weights & Biases keeps its files in run/wandb, and follows its own
    settings (WANDB_MODE and others). Raises MissingPackageError.
    """
    if name is None:
        yield None
        return
    check_tracker(name)
    if name == "wandb":
        tracker: GeneralTracker = WandBTracker(PROJECT, name=run.name, dir=str(run))
    else:
        tracker = TensorBoardTracker("tensorboard", logging_dir=run)
    tracker.start()
    try:
        yield RunTracker(tracker)
    finally:
        tracker.finish()
