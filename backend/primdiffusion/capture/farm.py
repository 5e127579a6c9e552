"""Captures on many machines: Ray spreads the people of a dataset over workers, one renderer process at a time each.

A person is a task. Everything a renderer does is resumable and atomic (see `layout`), so a person whose worker was
killed is given to another one and continues with the view that was not finished; nothing is lost, nothing made twice.
"""

from __future__ import annotations

import ctypes
import dataclasses
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

LIST, ONLY = ("--list", "--progress", "json"), ("--progress", "none", "--only")
"""What a renderer's command must understand: to tell its subjects, {"line": NAME} on marked lines; to render one."""
MARK = "PRIMDIFFUSION "
_LINES_OF_ERROR = 5
_SET_PARENT_DEATH_SIGNAL = 1


class FarmError(ValueError):
    """The farm cannot begin: no Ray, no cluster, or a command that lists no subjects."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How one person's task ended."""

    subject: str
    exit_code: int
    seconds: float
    error: str
    """The renderer's last lines where it failed, else empty."""


@dataclasses.dataclass(frozen=True)
class Farm:
    """Where the tasks run."""

    address: str | None = None
    """Of a Ray cluster, "auto" for the one this machine belongs to; None starts one here."""
    workers: int = 1
    """Renderers at once, where the cluster is started here."""
    processors_each: float = 1
    gpus_each: float = 0
    """Of a cluster's GPUs to each renderer; Ray shows a renderer no others."""
    attempts: int = 3
    """Times a person is tried whose worker or renderer is killed."""


def subjects_of(command: Sequence[str]) -> list[str]:
    """The subjects that a renderer's command would render. Raises FarmError where it names none."""
    try:
        ran = subprocess.run([*command, *LIST], capture_output=True, text=True, check=False)
    except OSError as e:
        raise FarmError(f"the renderer {command[0]!r} cannot be started ({e}): give its path") from e
    told = [json.loads(line.removeprefix(MARK)) for line in ran.stdout.splitlines() if line.startswith(MARK)]
    if ran.returncode or not told:
        raise FarmError(f"{' '.join([*command, *LIST])} names no subjects: {_tail(ran.stderr) or 'it is silent'}")
    return [line["line"] for line in told]


def render_on(
    farm: Farm, command: Sequence[str], report: Callable[[Outcome, int, int], None] = lambda outcome, done, total: None
) -> list[Outcome]:
    """Renders every subject of `command`, and returns how each ended; `report` hears of each as it ends.

    The command runs on whatever machine has room: its paths must mean the same files on all of them. Raises FarmError.
    """
    subjects = subjects_of(command)
    ray = _started(farm)
    try:
        task = ray.remote(
            num_cpus=farm.processors_each, num_gpus=farm.gpus_each, max_retries=farm.attempts - 1, max_calls=1
        )(render_one)
        waiting = {task.remote(list(command), subject, farm.attempts): subject for subject in subjects}
        outcomes = []
        while waiting:
            finished, _ = ray.wait(list(waiting), num_returns=1)
            subject = waiting.pop(finished[0])
            try:
                outcome = ray.get(finished[0])
            except ray.exceptions.RayError as e:
                outcome = Outcome(subject, -1, 0.0, f"its worker was lost {farm.attempts} times ({type(e).__name__})")
            outcomes.append(outcome)
            report(outcome, len(outcomes), len(subjects))
        return sorted(outcomes, key=lambda outcome: outcome.subject)
    finally:
        ray.shutdown()


def render_one(command: list[str], subject: str, attempts: int) -> Outcome:
    """The task: one renderer process, started again where it is killed, but not where it says what is wrong."""
    began, exit_code, error = time.monotonic(), -1, ""
    for _ in range(attempts):
        process = subprocess.Popen(
            [*command, *ONLY, subject],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, preexec_fn=_die_with_parent,
        )  # fmt: skip
        error = _tail(process.communicate()[1])
        exit_code = process.returncode
        if exit_code >= 0:
            break
    return Outcome(subject, exit_code, time.monotonic() - began, error if exit_code else "")


def _started(farm: Farm) -> Any:
    try:
        import ray  # pyright: ignore[reportMissingImports]  # an extra
    except ImportError as e:
        raise FarmError("Ray is not installed: pip install 'primdiffusion[farm]'") from e
    local: dict[str, Any] = {} if farm.address else {"num_cpus": max(1, round(farm.workers * farm.processors_each))}
    if not farm.address and farm.gpus_each:
        local["num_gpus"] = max(1, round(farm.workers * farm.gpus_each))
    try:
        ray.init(address=farm.address or "local", include_dashboard=None if farm.address else False, **local)
    except (ConnectionError, RuntimeError, ValueError, OSError) as e:
        raise FarmError(f"no Ray cluster at {farm.address or 'this machine'} ({e}): start one with `ray start`") from e
    return ray


def _die_with_parent() -> None:
    """A renderer must not go on alone when its worker is killed: the person is given to another one."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)


def _tail(text: str) -> str:
    return " | ".join(line for line in text.strip().splitlines()[-_LINES_OF_ERROR:] if line.strip())
