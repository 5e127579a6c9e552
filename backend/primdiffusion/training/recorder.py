"""Record a run: metrics, images and a progress bar; and stop it between two steps."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import FrameType
from typing import Protocol

import torch
from tqdm import tqdm

from primdiffusion.formats.json_files import parse_message
from primdiffusion.training.state import TrainingState

log = logging.getLogger(__name__)

MEMORY = 25
"""Approximate window of the running means in metrics.jsonl, steps."""
IMPATIENT = 2.0
"""Seconds after the first Ctrl-C before a second one stops at once: launchers forward the first one twice."""
SIGNALS = (signal.SIGINT, signal.SIGTERM)


@dataclasses.dataclass(frozen=True)
class StepMetrics:
    """Metrics of one optimiser step."""

    step: int
    terms: dict[str, float]
    """Weighted terms of the objective on the batch of this process."""
    gradient: float
    """Norm of the gradient before clipping."""
    seconds: dict[str, float]
    """Times of the parts of a step; the last includes the update."""


class StepTimer:
    """Measures seconds between laps, synchronising the device."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.seconds = device, {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """End a lap."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        elif self.device.type == "mps":
            torch.mps.synchronize()
        now = time.perf_counter()
        self.seconds[name] = now - self._last
        self._last = now


class Every(Protocol):
    """Intervals of logging, evaluation and images, in steps."""

    @property
    def log_every(self) -> int: ...
    @property
    def evaluate_every(self) -> int: ...
    @property
    def pictures_every(self) -> int: ...


class Recorder(ABC):
    """Writes metrics.jsonl and images and shows a progress bar, in the main process.

    Running means are saved in the state, so that a resumed run writes the same lines as an uninterrupted one.
    """

    def __init__(self, steps: int, every: Every, state: TrainingState, name: str | None = None) -> None:
        self.steps, self.every, self.state, self.name = steps, every, state, name
        self.means: dict[str, float] = parse_message(state.place.get("means", "{}"))

    def __enter__(self) -> Recorder:
        self.bar = tqdm(total=self.steps, initial=self.state.step, desc=self.name, unit="step", disable=None)
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.close()

    def __call__(self, progress: StepMetrics) -> None:
        """Record a step. Raises OSError if the disk is full."""
        row = {**progress.terms, "gradient": progress.gradient}
        row |= {f"seconds_{name}": value for name, value in progress.seconds.items()}
        for name, value in row.items():
            before = self.means.get(name, value)
            self.means[name] = before + (value - before) / min(progress.step, MEMORY)
        self.state.place["means"] = json.dumps(self.means)
        self.bar.update()
        if self._due(progress.step, self.every.log_every):
            self._write(self.means)
        if self._due(progress.step, self.every.evaluate_every):
            self._write(self.measured())
        if self._due(progress.step, self.every.pictures_every):
            self.draw()

    @abstractmethod
    def measured(self) -> dict[str, float]:
        """Evaluate the averaged weights."""

    @abstractmethod
    def draw(self) -> None:
        """Write images generated with the averaged weights."""

    @abstractmethod
    def append(self, row: Mapping[str, float]) -> None:
        """Append a line to metrics.jsonl."""

    def _due(self, step: int, every: int) -> bool:
        return step % every == 0 or step == self.steps

    def _write(self, values: Mapping[str, float]) -> None:
        step = self.state.step
        left = (self.steps - step) * sum(value for name, value in self.means.items() if name.startswith("seconds_"))
        shown = " ".join(f"{name}={value:.4g}" for name, value in values.items())
        of = f"{self.name}, " if self.name else ""
        log.info("%sstep %d of %d, %s left: %s", of, step, self.steps, tqdm.format_interval(left), shown)
        self.append({"step": step, "seconds": self.state.seconds, **values})


class Interrupt:
    """Stops loops after the current step: at a deadline, on SIGINT (Ctrl-C) or SIGTERM, so that no step is cut short.

    A second Ctrl-C, IMPATIENT seconds later, raises KeyboardInterrupt wherever the loop is.
    """

    def __init__(self, minutes: float | None):
        self.deadline = time.monotonic() + 60 * minutes if minutes is not None else float("inf")
        self.pressed = False
        self._at = 0.0
        self._process = os.getpid()
        self._before = {}

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._press) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _press(self, number: int, _frame: FrameType | None) -> None:
        if os.getpid() != self._process:
            return  # a loader's worker, which inherited this handler; its parent ends it
        if not self.pressed:
            log.info("stopping after this step")
            self.pressed, self._at = True, time.monotonic()
        elif number == signal.SIGINT and time.monotonic() - self._at > IMPATIENT:
            raise KeyboardInterrupt

    def due(self) -> bool:
        """Return whether to stop now."""
        return self.pressed or time.monotonic() > self.deadline
