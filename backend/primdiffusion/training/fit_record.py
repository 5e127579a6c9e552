"""What is seen of a run of stage 1 as it goes: lines of metrics, pictures, a bar."""

from __future__ import annotations

from collections.abc import Mapping

from primdiffusion.capture.reader import Captures
from primdiffusion.encoder.encode import EncoderModel
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.fit_pictures import measure, write_pictures
from primdiffusion.training.fit_state import FitState
from primdiffusion.training.recorder import Recorder
from primdiffusion.training.run_folder import PICTURES, append_metrics


class FitRecorder(Recorder):
    """Of an encoder: PSNR on a few people, and what it makes of them beside their captures."""

    def __init__(self, config: FitConfig, captures: Captures, held: Captures | None, state: FitState) -> None:
        super().__init__(config.steps, config, state)
        self.run, self.captures, self.held, self.fit_state = config.run, captures, held, state

    def measured(self) -> dict[str, float]:
        """PSNR of people that are trained on, and of those held out."""
        found = {"psnr_train": measure(self._model(), self.captures)}
        return found if self.held is None else {**found, "psnr_held": measure(self._model(), self.held)}

    def draw(self) -> None:
        """A row a person."""
        path = self.run / PICTURES / f"{self.state.step:07d}.png"
        write_pictures(path, self._model(), self.held or self.captures)

    def append(self, row: Mapping[str, float]) -> None:
        """A line of metrics.jsonl."""
        append_metrics(self.run, row)

    def _model(self) -> EncoderModel:
        return EncoderModel(self.fit_state.encoder, {})
