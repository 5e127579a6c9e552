"""What is seen of a run of stage 1 as it goes: lines of metrics, pictures, a bar."""

from __future__ import annotations

import dataclasses
import json
import logging
import time

import torch
from tqdm import tqdm

from primdiffusion.capture.reader import Captures
from primdiffusion.encoder.encode import EncoderModel
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.fit_folder import PICTURES, append_metrics
from primdiffusion.training.fit_pictures import measure, write_pictures
from primdiffusion.training.fit_state import FitState

log = logging.getLogger(__name__)

MEMORY = 25
"""Steps over which the means of metrics.jsonl reach, about."""


@dataclasses.dataclass(frozen=True)
class Progress:
    """One optimiser step."""

    step: int
    terms: dict[str, float]
    """The objective's terms, weighted; of this process' people."""
    gradient: float
    """Norm, before clipping."""
    seconds: dict[str, float]
    """data, forward, march, backward (which includes the update)."""


class Clock:
    """Seconds between laps, with the device's work waited for."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.seconds = device, {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Ends a lap."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        now = time.perf_counter()
        self.seconds[name] = now - self._last
        self._last = now


class Recorder:
    """metrics.jsonl, pictures and the bar; of the main process.

    Running means are part of the state's place, so that a resumed run writes the lines of one that never stopped.
    """

    def __init__(self, config: FitConfig, captures: Captures, held: Captures | None, state: FitState) -> None:
        self.config, self.captures, self.held, self.state = config, captures, held, state
        self.means: dict[str, float] = json.loads(state.place.get("means", "{}"))

    def __enter__(self) -> Recorder:
        self.bar = tqdm(total=self.config.steps, initial=self.state.step, unit="step", disable=None)
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.close()

    def __call__(self, progress: Progress) -> None:
        """Takes note of a step. Raises OSError where there is no room."""
        row = {**progress.terms, "gradient": progress.gradient}
        row |= {f"seconds_{name}": value for name, value in progress.seconds.items()}
        for name, value in row.items():
            before = self.means.get(name, value)
            self.means[name] = before + (value - before) / min(progress.step, MEMORY)
        self.state.place["means"] = json.dumps(self.means)
        self.bar.update()
        if self._due(progress.step, self.config.log_every):
            self._write(self.means)
        if self._due(progress.step, self.config.evaluate_every):
            self._write(self._measured())
        if self._due(progress.step, self.config.pictures_every):
            path = self.config.run / PICTURES / f"{progress.step:07d}.png"
            write_pictures(path, self._model(), self.held or self.captures)

    def _due(self, step: int, every: int) -> bool:
        return step % every == 0 or step == self.config.steps

    def _model(self) -> EncoderModel:
        return EncoderModel(self.state.encoder, {})

    def _measured(self) -> dict[str, float]:
        found = {"psnr_train": measure(self._model(), self.captures)}
        return found if self.held is None else {**found, "psnr_held": measure(self._model(), self.held)}

    def _write(self, values: dict[str, float]) -> None:
        step, steps = self.state.step, self.config.steps
        left = (steps - step) * sum(value for name, value in self.means.items() if name.startswith("seconds_"))
        shown = " ".join(f"{name}={value:.4g}" for name, value in values.items())
        log.info("step %d of %d, %s left: %s", step, steps, tqdm.format_interval(left), shown)
        append_metrics(self.config, {"step": step, "seconds": self.state.seconds, **values})
