"""The folder of a run, of either stage: starting, resuming and recording runs.

config.json      the settings
run.json         the training set; step, processes, versions and commit of every start
metrics.jsonl    metrics at intervals
pictures/        images at intervals
"""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import os
import platform
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import accelerate
import torch

from primdiffusion import __version__
from primdiffusion.formats.json_files import parse_json
from primdiffusion.formats.regular_files import read_regular
from primdiffusion.formats.whole_files import remove_abandoned, write_atomically
from primdiffusion.training.config import RunConfig, check_resumable, to_json
from primdiffusion.training.folder_lock import lock_folder

log = logging.getLogger(__name__)

Config = TypeVar("Config", bound=RunConfig)
Made = TypeVar("Made")
CONFIG, RUN, METRICS, PICTURES = "config.json", "run.json", "metrics.jsonl", "pictures"
LARGEST_TEXT = 2**30
"""Bytes of any of them."""


def alone(work: Callable[[Config], Made]) -> Callable[[Config], Made]:
    """Let a run hold its folder, of several processes of one run the first. Raises FolderInUseError, OSError."""

    @functools.wraps(work)
    def held(config: Config) -> Made:
        is_first = os.environ.get("RANK", "0") == "0"
        with lock_folder(config.run) if is_first else contextlib.nullcontext():
            return work(config)

    return held


def begin(
    config: RunConfig,
    people: Sequence[str],
    about: Mapping[str, Any],
    start: Mapping[str, Any],
    is_kept: Callable[[Mapping[str, Any]], bool],
) -> None:
    """Save settings, versions and names of the training set; when resuming, check that these are unchanged.

    `about` is saved with the names; `start` describes this start: its step and number of "processes". Lines of
    metrics.jsonl for which `is_kept` is false belong to steps lost in a kill and are removed.

    Raises:
        ValueError: settings or training set differ from those of the run, or files are damaged.
        OSError: the folder cannot be written to.
    """
    saved, noted = config.run / CONFIG, config.run / RUN
    started = {"people": list(people), **about, "starts": []}
    if saved.exists():
        check_resumable(_text(saved), config)
        if noted.exists():
            started["starts"] = _earlier(config, people, _text(noted), start["processes"])
        _cut_metrics(config.run / METRICS, is_kept)
        remove_abandoned(config.run)
    now = {**start, "primdiffusion": __version__, **versions()}
    write_atomically(saved, to_json(config))
    write_atomically(noted, json.dumps({**started, "starts": [*started["starts"], now]}, indent=1))


def append_metrics(run: Path, row: Mapping[str, Any]) -> None:
    """Append a line to metrics.jsonl. Raises OSError, naming the file."""
    path = run / METRICS
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from error


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


def _earlier(config: RunConfig, people: Sequence[str], saved: str, processes: int) -> list[Mapping[str, Any]]:
    """Return the earlier starts of the run. Raises ValueError for another training set."""
    try:
        before = parse_json(saved)
        known, starts = before["people"], before.get("starts", [])
        were = starts[-1]["processes"] if starts else processes
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"{config.run / RUN} is damaged ({error!s:.160}): give a new folder") from error
    if known != list(people):
        raise ValueError(
            f"the run in {config.run} has another training set than {config.data} ({len(known)} and {len(people)} "
            "humans): give the same data, or a new folder"
        )
    if were != processes:
        log.warning("resuming on %d processes instead of %d: batches will differ", processes, were)
    return starts


def _cut_metrics(path: Path, is_kept: Callable[[Mapping[str, Any]], bool]) -> None:
    if path.exists():
        lines = _text(path).splitlines()
        write_atomically(path, "".join(line + "\n" for line in lines if _is_kept(line, is_kept)))


def _is_kept(line: str, is_kept: Callable[[Mapping[str, Any]], bool]) -> bool:
    """Also False for a truncated line."""
    try:
        return is_kept(parse_json(line))
    except (ValueError, KeyError, TypeError):
        return False


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        ["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=10, check=True
    )  # fmt: skip
    return done.stdout.strip()


def _text(path: Path) -> str:
    return read_regular(path, LARGEST_TEXT).decode("utf-8", "replace")
