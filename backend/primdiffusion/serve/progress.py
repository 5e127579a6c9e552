"""What a job tells while it is at work: steps, the time that is left, pictures of what is there so far."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol

from primdiffusion.diffusion.samplers import Step


class Report(Protocol):
    """The listener of a job."""

    def __call__(self, stage: str, step: int, total: int, eta_s: float | None, /, **more: Any) -> None:
        """`eta_s` are seconds; `more` may be `picture`, a PNG's path, and `index`, whose it is. Raises to end it."""
        ...


class Pace:
    """How long steps take, from those after the first, which warms up."""

    def __init__(self) -> None:
        self._times: list[float] = []

    def left(self, done: int, total: int) -> float | None:
        """Seconds until `total`, told each time a step is done; None after the first one."""
        self._times.append(time.perf_counter())
        if len(self._times) < 2:
            return None
        return round((self._times[-1] - self._times[0]) / (len(self._times) - 1) * (total - done), 3)


def no_picture(_step: Step) -> str | None:
    """What a job without pictures shows after a step."""
    return None


def step_reporter(report: Report, picture: Callable[[Step], str | None] = no_picture) -> Callable[[Step], None]:
    """Reports each step with the seconds left, and the picture that there may be of it."""
    pace = Pace()

    def on_step(step: Step) -> None:
        path = picture(step)
        more = {} if path is None else {"picture": path}
        done = step.index + 1
        report("sample", done, step.total, pace.left(done, step.total), **more)

    return on_step
