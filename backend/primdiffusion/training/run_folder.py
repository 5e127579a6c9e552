"""The folder of a run: starting, resuming and recording runs.

config.json                 the settings
run.json                    the training set; steps, processes, versions and commit of every start
metrics.jsonl               metrics at intervals, which TensorBoard or Weights & Biases get as well if asked for
pictures/                   images at intervals
state.safetensors           the state of the network, to resume from
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import os
import platform
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import accelerate
import torch
from accelerate.tracking import GeneralTracker, TensorBoardTracker, WandBTracker

from primdiffusion.files.json_files import parse_json
from primdiffusion.files.regular_files import as_file_error, check_unlinked, open_to_append, read_regular, real_path
from primdiffusion.files.whole_files import remove_abandoned, write_atomically
from primdiffusion.runtime.failures import optional_package
from primdiffusion.runtime.worker_process import lock_folder
from primdiffusion.training.config import RunSettings, check_resumable, to_json
from primdiffusion.training.state import accelerator_of, saved_step
from primdiffusion.version import __version__

log = logging.getLogger(__name__)

CONFIG, RUN, METRICS, PICTURES, STATE = "config.json", "run.json", "metrics.jsonl", "pictures", "state.safetensors"
LARGEST_TEXT = 2**30
"""Largest size of one of them, bytes."""


@contextlib.contextmanager
def open_run(config: RunSettings, mixed_precision: str = "no") -> Iterator[accelerate.Accelerator]:
    """Hold the folder of a run, by the first of its processes, and yield the accelerator of this process.

    Raises MissingPackageError for the tracker's package; ValueError, OSError.
    """
    if config.threads:
        torch.set_num_threads(config.threads)
    if config.tracker is not None:
        optional_package(config.tracker, "tracking")
    is_first = os.environ.get("RANK", "0") == "0"
    if is_first:
        check_unlinked(real_path(config.run))  # TensorBoard and Weights & Biases write there, too
    with lock_folder(config.run) if is_first else contextlib.nullcontext():
        accelerator = accelerator_of(mixed_precision)
        yield accelerator
        accelerator.end_training()


def begin(config: RunSettings, people: Sequence[str], about: Mapping[str, Any], processes: int) -> None:
    """Save settings, versions and names of the training set; when resuming, check that these are unchanged.

    `about` is saved with the names. Lines of metrics.jsonl of steps after the saved state, which were lost in a kill,
    are removed.

    Raises:
        ValueError: settings or training set differ from those of the run, or files are damaged.
        OSError: the folder cannot be written to.
    """
    log.info("training on %d %s", processes, "process" if processes == 1 else "processes, each with its own batches")
    step, saved, noted = saved_step(config.run / STATE), config.run / CONFIG, config.run / RUN
    started = {"people": list(people), **about, "starts": []}
    if saved.exists():
        check_resumable(_text(saved), config)
        if noted.exists():
            started["starts"] = _earlier(config, people, _text(noted), processes)
        _cut_metrics(config.run / METRICS, step)
        remove_abandoned(config.run, after_s=0)
    now = {"step": step, "processes": processes, "primdiffusion": __version__, **versions()}
    write_atomically(saved, to_json(config))
    write_atomically(noted, json.dumps({**started, "starts": [*started["starts"], now]}, indent=1))


@dataclasses.dataclass(frozen=True)
class Metrics:
    """Writes lines of metrics.jsonl, and sends them to a tracker as well if the run has one."""

    run: Path
    tracker: GeneralTracker | None = None

    def append(self, row: Mapping[str, float]) -> None:
        """Append a line, with its step. Raises OSError, naming the file."""
        path = self.run / METRICS
        try:
            with open_to_append(path) as file:
                file.write(json.dumps(row).encode() + b"\n")
        except OSError as error:
            raise type(error)(error.errno, error.strerror, str(path)) from error
        if self.tracker is not None:
            self.tracker.log(dict(row), step=int(row["step"]))


@contextlib.contextmanager
def open_metrics(config: RunSettings) -> Iterator[Metrics]:
    """Open the metrics of a run with its tracker, in the main process alone.

    TensorBoard's events are in run/tensorboard. Weights & Biases keeps its files in run/wandb, and follows its own
    settings (WANDB_MODE and others).
    """
    if config.tracker is None:
        yield Metrics(config.run)
        return
    if config.tracker == "wandb":
        tracker: GeneralTracker = WandBTracker("primdiffusion", name=config.run.name, dir=str(config.run))
    else:
        tracker = TensorBoardTracker("tensorboard", logging_dir=config.run)
    tracker.start()
    try:
        yield Metrics(config.run, tracker)
    finally:
        tracker.finish()


def versions() -> dict[str, str]:
    """Return versions of Python, torch and accelerate, and a checkout's commit, "-dirty" where files differ from it."""
    found = {
        "python": platform.python_version(),
        "torch": torch.__version__,
        "accelerate": accelerate.__version__,
        "machine": platform.machine(),
    }
    here = Path(__file__)
    try:
        _git(here.parent, "ls-files", "--error-unmatch", here.name)  # an environment may lie in another checkout
        return {**found, "commit": _git(here.parent, "describe", "--always", "--dirty", "--exclude", "*")}
    except (OSError, subprocess.SubprocessError):
        return found


def _earlier(config: RunSettings, people: Sequence[str], saved: str, processes: int) -> list[Mapping[str, Any]]:
    """Return the earlier starts of the run. Raises ValueError for another training set."""
    with as_file_error(config.run / RUN, "is damaged", "give a new folder"):
        before = parse_json(saved)
        known, starts = before["people"], before.get("starts", [])
        were = starts[-1]["processes"] if starts else processes
    if known != list(people):
        raise ValueError(
            f"the run in {config.run} has another training set than {config.data} ({len(known)} and {len(people)} "
            "humans): give the same data, or a new folder"
        )
    if were != processes:
        log.warning("resuming on %d processes instead of %d: batches will differ", processes, were)
    return starts


def _cut_metrics(path: Path, step: int) -> None:
    if path.exists():
        lines = _text(path).splitlines()
        write_atomically(path, "".join(line + "\n" for line in lines if _is_kept(line, step)))


def _is_kept(line: str, step: int) -> bool:
    """Whether a line is complete and of a step that is saved."""
    try:
        return parse_json(line)["step"] <= step
    except (ValueError, LookupError, TypeError, AttributeError):
        return False


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=10, check=True)
    return done.stdout.strip()


def _text(path: Path) -> str:
    return read_regular(path, LARGEST_TEXT).decode("utf-8", "replace")
