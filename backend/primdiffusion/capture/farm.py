"""Render captures on many machines: Ray distributes the subjects of a dataset over renderer processes.

One subject is one task. Renderers resume and write atomically (`formats/capture_layout.py`), so if a worker is killed,
another continues its subject with the first unfinished view.
"""

from __future__ import annotations

import ctypes
import dataclasses
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from primdiffusion.capture.people_files import SUBJECT_NAME
from primdiffusion.files.json_files import parse_json
from primdiffusion.runtime.failures import optional_package

LIST, ONLY = ("--list", "--progress", "json"), ("--progress", "none", "--only")
"""Options that a renderer must support: list its subjects as {"line": NAME} on marked lines, and render one."""
MARK = "PRIMDIFFUSION "
_LINES_OF_ERROR = 5
_SET_PARENT_DEATH_SIGNAL = 1
_NO_WINDOW = getattr(subprocess, "CREATE_NO_WINDOW", 0)
_LARGEST_EXIT_CODE = 0x7FFFFFFF
"""Windows states crashes as larger numbers, other systems signals as negative ones."""


@dataclasses.dataclass(frozen=True)
class FarmResult:
    """The result of rendering one subject."""

    subject: str
    exit_code: int
    seconds: float
    error: str
    """The renderer's last lines if it failed, else empty."""


@dataclasses.dataclass(frozen=True)
class Farm:
    """The cluster, and the resources of each renderer."""

    address: str | None = None
    """Address of a Ray cluster; "auto" for the one of this machine; the default starts one here."""
    workers: int = 1
    """Renderers at a time, if the cluster is started here."""
    processors_each: float = 1
    """Cores of each renderer."""
    gpus_each: float = 0
    """GPUs of each renderer; with 0.5 two share one. Ray hides the others from it."""
    attempts: int = 3
    """Attempts for a human whose worker or renderer is killed."""


def subjects_of(command: Sequence[str]) -> list[str]:
    """List the subjects that a renderer's command would render. Raises ValueError if there are none."""
    try:
        ran = subprocess.run(
            [*command, *LIST],
            capture_output=True, encoding="utf-8", errors="replace", check=False, creationflags=_NO_WINDOW,
        )  # fmt: skip
    except OSError as e:
        raise ValueError(f"the renderer {command[0]!r} cannot be started ({e!s:.160}): give its path") from e
    listed = [parse_json(line.removeprefix(MARK)) for line in ran.stdout.splitlines() if line.startswith(MARK)]
    if ran.returncode or not listed:
        raise ValueError(
            f"{' '.join([*command, *LIST])} names no subjects: {_tail(ran.stderr) or 'it printed nothing'}"
        )
    names: list[str] = []
    for line in listed:
        name = line.get("line") if isinstance(line, dict) else line
        if not isinstance(name, str) or not SUBJECT_NAME.fullmatch(name):
            raise ValueError(f"{command[0]} lists the subject {name!r:.80}: give its file a name of letters and digits")
        names.append(name)
    return names


def render_on(
    farm: Farm,
    command: Sequence[str],
    report: Callable[[FarmResult, int, int], None] = lambda result, done, total: None,
) -> list[FarmResult]:
    """Render every subject of `command` and return the results; `report` gets each, the number done, and the total.

    The command may run on any machine of the cluster, so its paths must be valid on all. Raises ValueError.
    """
    subjects = subjects_of(command)
    ray = _started(farm)
    try:
        task = ray.remote(
            num_cpus=farm.processors_each, num_gpus=farm.gpus_each, max_retries=farm.attempts - 1, max_calls=1
        )(render_one)
        waiting = {task.remote(list(command), subject, farm.attempts): subject for subject in subjects}
        results = []
        while waiting:
            finished, _ = ray.wait(list(waiting), num_returns=1)
            subject = waiting.pop(finished[0])
            try:
                result = ray.get(finished[0])
            except ray.exceptions.RayError as e:
                result = FarmResult(subject, -1, 0.0, f"its worker was lost {farm.attempts} times ({type(e).__name__})")
            results.append(result)
            report(result, len(results), len(subjects))
        return sorted(results, key=lambda result: result.subject)
    finally:
        ray.shutdown()


def render_one(command: list[str], subject: str, attempts: int) -> FarmResult:
    """The Ray task: run one renderer; restart it if it is killed, but not if it reports an error."""
    began, exit_code, error = time.monotonic(), -1, ""
    for _ in range(attempts):
        process = subprocess.Popen(
            [*command, *ONLY, subject],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, encoding="utf-8", errors="replace",
            preexec_fn=_die_with_parent if sys.platform == "linux" else None, creationflags=_NO_WINDOW,
        )  # fmt: skip
        error = _tail(process.communicate()[1])
        exit_code = process.returncode
        if 0 <= exit_code <= _LARGEST_EXIT_CODE:
            break
    return FarmResult(subject, exit_code, time.monotonic() - began, error if exit_code else "")


def _started(farm: Farm) -> Any:
    ray = optional_package("ray", "farm")
    local: dict[str, Any] = {} if farm.address else {"num_cpus": max(1, round(farm.workers * farm.processors_each))}
    if not farm.address and farm.gpus_each:
        local["num_gpus"] = max(1, round(farm.workers * farm.gpus_each))
    try:
        ray.init(address=farm.address or "local", include_dashboard=None if farm.address else False, **local)
    except (ConnectionError, RuntimeError, ValueError, OSError) as e:
        raise ValueError(
            f"no Ray cluster at {farm.address or 'this machine'} ({e!s:.160}): start one with `ray start`"
        ) from e
    return ray


def _die_with_parent() -> None:
    """End the renderer with its worker, because another worker takes over the subject. Linux only."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)


def _tail(text: str) -> str:
    return " | ".join(line for line in text.strip().splitlines()[-_LINES_OF_ERROR:] if line.strip())
