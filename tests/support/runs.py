"""Runs of commands: their processes, and what training leaves in a folder."""

import itertools
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from primdiffusion.runtime.failures import to_user_error
from safetensors.torch import load_file

_TESTS = Path(__file__).parents[1]


def within(seconds: float, reached: Callable[[], object]) -> bool:
    """Whether a state is reached in time."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and not reached():
        time.sleep(0.1)
    return bool(reached())


def child_environment() -> dict[str, str]:
    """For processes that import helpers of tests."""
    paths = (_TESTS / "backend", _TESTS, os.environ.get("PYTHONPATH", ""))
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths)), "OMP_NUM_THREADS": "1"}


def sentence(error: BaseException) -> str:
    """What the command line would print of an error; a defect has none."""
    failure = to_user_error(error)
    assert failure is not None
    assert "\n" not in str(failure)
    return str(failure)


class Ended(Exception):
    """By its owner."""


def ended_at_each_report(work: Callable[[Callable[..., None]], Any], out: Path) -> tuple[Any, list[tuple]]:
    """Do work that writes a folder, ended at each of its reports in turn, which leaves no folder, then to its end.

    Returns the answer of the last and its reports.
    """
    for end in itertools.count():
        reports = []

        def report(*about: object, end=end, reports=reports, **_: object) -> None:
            if len(reports) == end:
                raise Ended
            reports.append(about)

        try:
            answer = work(report)
        except Ended:
            assert not out.exists()
        else:
            assert len(reports) == end > 1
            return answer, reports
    raise AssertionError


def rows(run: Path) -> list[dict]:
    """Of metrics.jsonl."""
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def timeless(run: Path) -> list[dict]:
    """Lines of metrics.jsonl without what a clock says."""
    return [{name: value for name, value in row.items() if not name.startswith("seconds")} for row in rows(run)]


def same_tensors(one: Path, other: Path) -> bool:
    """Whether two safetensors files hold the same, bit for bit."""
    a, b = load_file(one), load_file(other)
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)
