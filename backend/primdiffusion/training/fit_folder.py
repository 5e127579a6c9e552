"""The folder of a run of stage 1: what is in it, how a run begins or goes on in it, and how it is saved."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from typing import Any

import psutil

from primdiffusion import __version__
from primdiffusion.capture.reader import Captures
from primdiffusion.encoder.encode import EncoderModel
from primdiffusion.training.config import check_resumable, to_json, write_atomically
from primdiffusion.training.encoder_checkpoint import save_encoder
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.fit_state import FitState, versions

log = logging.getLogger(__name__)

CONFIG, RUN, METRICS = "config.json", "run.json", "metrics.jsonl"
STATE, MODEL, PICTURES = "state.safetensors", "encoder.safetensors", "pictures"


def begin(config: FitConfig, captures: Captures, processes: int) -> None:
    """Settings, versions and whom it is trained on; or, in a run's folder, the proof that these are as before.

    Raises:
        ValueError: other settings or other people than those with which the run began, or damaged files.
        OSError: the folder cannot be written to.
    """
    saved, about = config.run / CONFIG, config.run / RUN
    started = {"people": list(captures.subjects), "captures": dict(captures.about), "starts": []}
    if saved.exists():
        check_resumable(saved.read_text(encoding="utf-8"), config)
        step = FitState.saved_step(config.run / STATE)
        if about.exists():
            started |= _resumed(config, started, about.read_text(encoding="utf-8"), processes)
        _cut_metrics(config, step)
        _remove_leftovers(config)
    else:
        step = 0
    start = {"step": step, "processes": processes, "primdiffusion": __version__, **versions()}
    write_atomically(saved, to_json(config))
    write_atomically(about, json.dumps({**started, "starts": [*started["starts"], start]}, indent=1))


def save(config: FitConfig, state: FitState, model: EncoderModel) -> None:
    """Encoder and state, each whole or as it was. A kill between them leaves an encoder newer than the state.

    Raises:
        CheckpointError, NotFiniteError: weights are not finite; nothing is replaced by them.
        OSError: there is no room.
    """
    save_encoder(config.run / MODEL, model)
    state.save(config.run / STATE)


def append_metrics(config: FitConfig, row: Mapping[str, float]) -> None:
    """One line of metrics.jsonl. Raises OSError, which names the file."""
    path = config.run / METRICS
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from error


def _resumed(config: FitConfig, now: Mapping[str, Any], saved: str, processes: int) -> dict[str, Any]:
    """Earlier starts of the run, which must have been with the same people."""
    try:
        before = json.loads(saved)
        people, starts = before["people"], before.get("starts", [])
        were = starts[-1]["processes"] if starts else processes
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"{config.run / RUN} is damaged ({error}): give a new folder") from error
    if people != now["people"]:
        raise ValueError(
            f"the run in {config.run} was begun with other people than those of {config.data} ({len(people)} and "
            f"{len(now['people'])} of them): give the same captures, or a new folder"
        )
    if were != processes:
        log.warning("%d processes, before %d: other batches follow", processes, were)
    return {"starts": starts}


def _cut_metrics(config: FitConfig, step: int) -> None:
    """Lines behind the saved state belong to steps that a kill undid; they will be written again."""
    path = config.run / METRICS
    if path.exists():
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        write_atomically(path, "".join(line + "\n" for line in lines if _step_of(line) <= step))


def _step_of(line: str) -> float:
    try:
        return json.loads(line)["step"]
    except (ValueError, KeyError, TypeError):
        return float("inf")


def _remove_leftovers(config: FitConfig) -> None:
    """What a process that was killed while it wrote left: `.NAME.PID.partial`."""
    for path in config.run.glob(".*.partial"):
        process = path.name.split(".")[-2]
        if process.isdecimal() and not psutil.pid_exists(int(process)):
            path.unlink(missing_ok=True)
