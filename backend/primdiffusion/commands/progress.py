"""What a request at work reports: steps, the time that is left, pictures of the result so far."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Protocol

from tqdm import tqdm

if TYPE_CHECKING:
    from primdiffusion.diffusion.samplers import SamplerStep


class Report(Protocol):
    """The listener of a request at work."""

    def __call__(self, stage: str, step: int, total: int, eta_s: float | None, /, **more: Any) -> None:
        """`eta_s` are seconds; `more` may be `picture`, a PNG's path, and `index`, whose it is. Raises to end it."""
        ...


class Pace:
    """How long steps take, from those after the first, which warms up."""

    def __init__(self) -> None:
        self._times: list[float] = []

    def left(self, done: int, total: int) -> float | None:
        """Seconds until `total`; call it each time a step is done. None after the first one."""
        self._times.append(time.perf_counter())
        if len(self._times) < 2:
            return None
        return round((self._times[-1] - self._times[0]) / (len(self._times) - 1) * (total - done), 3)


def no_picture(_step: SamplerStep) -> str | None:
    """The picture after a step of a request without pictures."""
    return None


def step_reporter(
    report: Report, picture: Callable[[SamplerStep], str | None] = no_picture
) -> Callable[[SamplerStep], None]:
    """Reports each step with the seconds left, and its picture where there is one."""
    pace = Pace()

    def on_step(step: SamplerStep) -> None:
        path = picture(step)
        more = {} if path is None else {"picture": path}
        done = step.index + 1
        report("sample", done, step.total, pace.left(done, step.total), **more)

    return on_step


@contextlib.contextmanager
def progress_bar(label: str | None = None) -> Iterator[Report]:
    """Shows the sampler's steps on stderr where that is a terminal."""
    with tqdm(desc=label, unit="step", disable=None) as bar:

        def report(stage: str, step: int, total: int, _eta_s: float | None, /, **_more: Any) -> None:
            if stage == "sample":
                bar.total = total
                bar.update(step - bar.n)

        yield report
