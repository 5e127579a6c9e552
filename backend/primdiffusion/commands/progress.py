"""Progress of requests and command lines: reports, the time left, a bar. Needs no torch."""

from __future__ import annotations

import collections
import contextlib
import itertools
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from tqdm import tqdm

from primdiffusion.files.regular_files import printable

if TYPE_CHECKING:
    from primdiffusion.diffusion.samplers import SamplerStep


class ReportProgress(Protocol):
    """Receives the progress of a running request."""

    def __call__(self, stage: str, step: int, total: int, eta_s: float | None, /, **more: Any) -> None:
        """`eta_s`: seconds left; `more`: `picture`, a preview's path, and `index`, its sample. May raise to cancel."""
        ...


_PACED_BY = 10
"""Steps."""
_UNUSUAL = 3.0
"""Times the median: previews make a step longer, but less so."""


class EtaEstimator:
    """Estimates the time left from the last steps, without the first and those that take far longer than most: they
    load and compile."""

    def __init__(self) -> None:
        self._times: collections.deque[float] = collections.deque(maxlen=_PACED_BY + 1)

    def left(self, done: int, total: int) -> float | None:
        """Return the seconds until `total`; call it after each step. None after the first two, unless it is 0."""
        self._times.append(time.perf_counter())
        if done >= total:
            return 0.0
        if len(self._times) < 3:
            return None
        steps = [after - before for before, after in itertools.pairwise(self._times)]
        usual = [step for step in steps if step <= _UNUSUAL * statistics.median_low(steps)]
        return round(statistics.mean(usual) * (total - done), 3)


def step_reporter(
    report: ReportProgress, picture: Callable[[SamplerStep], Path | None]
) -> Callable[[SamplerStep], None]:
    """Return a function that reports a step with the seconds left and the path of its preview, if it has one."""
    pace = EtaEstimator()

    def on_step(step: SamplerStep) -> None:
        path = picture(step)
        more = {} if path is None else {"picture": path}
        done = step.index + 1
        report("sample", done, step.total, pace.left(done, step.total), **more)

    return on_step


@contextlib.contextmanager
def progress_bar() -> Iterator[ReportProgress]:
    """Show the steps of a stage on stderr, if that is a terminal, and print humans as they are finished."""
    with tqdm(disable=None) as bar:

        def report(stage: str, step: int, total: int, _eta_s: float | None, /, **more: Any) -> None:
            if "human" in more:
                with bar.external_write_mode(sys.stdout):
                    show(more["human"])
            if total > 1:
                bar.set_description(stage, refresh=False)
                bar.total = total
                bar.update(step - bar.n)

        yield report


def show(answer: Any) -> None:
    """Print an answer, if there is one, and its warnings."""
    if answer is not None:
        print(answer, flush=True)
        print_warnings(getattr(answer, "warnings", ()))


def print_warnings(warnings: Iterable[str]) -> None:
    """Print a line on stderr for each."""
    for warning in warnings:
        print(printable(f"primdiffusion: warning: {warning}"), file=sys.stderr)
