"""A run of stage 1: its state, its folder, and the metrics and images it records."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
from accelerate import Accelerator
from PIL import Image
from torch import Tensor

from primdiffusion.capture.conditioning import default_betas
from primdiffusion.capture.dataset import CaptureDataset, SampleSettings, TrainingSample
from primdiffusion.capture.reader import Captures
from primdiffusion.encoder.blocks import UntiedConv
from primdiffusion.encoder.model import EncoderModel, save_encoder
from primdiffusion.encoder.network import Encoder
from primdiffusion.evaluation.image_metrics import psnr
from primdiffusion.formats.whole_files import written_whole
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.render.march import march
from primdiffusion.training import run_folder
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.recorder import Recorder
from primdiffusion.training.run_folder import PICTURES, append_metrics
from primdiffusion.training.state import AcceleratedState
from primdiffusion.training.trackers import RunTracker

STATE, MODEL = "state.safetensors", "encoder.safetensors"
SIZE = 256
PEOPLE = 6
SEED = 7


class FitState(AcceleratedState):
    """State of an encoder; `place["position"]` is the position in the data, as JSON."""

    def __init__(self, encoder: Encoder, config: FitConfig, accelerator: Accelerator) -> None:
        self.place_rate = config.place_rate
        super().__init__(encoder, config, config.seed, accelerator)

    def _groups(self) -> list[dict[str, object]]:
        """An untied bias is used once per image, a weight at every pixel: with equal rates the weights diverge."""
        biases = [m.bias for m in self.network.modules() if isinstance(m, UntiedConv)]
        known = {id(bias) for bias in biases}
        others = [parameter for parameter in self.network.parameters() if id(parameter) not in known]
        return [{"params": others, "factor": 1.0}, {"params": biases, "factor": self.place_rate}]

    @property
    def encoder(self) -> Encoder:
        """The encoder with averaged weights, which is evaluated and saved."""
        assert isinstance(self.average, Encoder)
        return self.average


def begin(config: FitConfig, captures: Captures, processes: int) -> None:
    """Start or resume the run with these captures; raises as `run_folder.begin`."""
    step = FitState.saved_step(config.run / STATE)
    run_folder.begin(
        config,
        captures.subjects,
        {"captures": dict(captures.about)},
        {"step": step, "processes": processes},
        lambda row: row["step"] <= step,
    )


def save(config: FitConfig, state: FitState, model: EncoderModel) -> None:
    """Save encoder and state, each atomically. A kill in between leaves an encoder newer than the state.

    Raises:
        CheckpointError, NotFiniteError: weights are not finite; nothing is replaced by them.
        OSError: there is no room.
    """
    save_encoder(config.run / MODEL, model)
    state.save(config.run / STATE)


def measure(model: EncoderModel, captures: Captures, people: int = PEOPLE) -> float:
    """Mean PSNR (dB, images of SIZE x SIZE pixels) of two views of each of a few subjects, in another pose."""
    found = [psnr(image, target) for image, target, _ in _compared(model, captures, people, "whole")]
    return float(torch.cat(found).mean())


def write_pictures(path: Path, model: EncoderModel, captures: Captures, people: int = PEOPLE) -> None:
    """Write a row for each subject: an input image, then twice a rendered one beside its capture, in another pose."""
    rows = []
    for image, target, given in _compared(model, captures, people, "crop"):
        pairs = [side for pair in zip(image, target, strict=True) for side in pair]
        rows.append(torch.cat([given, *pairs], dim=1))
    picture = (torch.cat(rows).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as unfinished:
        Image.fromarray(np.ascontiguousarray(picture)).save(unfinished, format="PNG")


@torch.no_grad()
def _compared(
    model: EncoderModel, captures: Captures, people: int, framing: str
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield for each subject two rendered images, the captured ones and an input, sRGB-encoded on the CPU."""
    settings = SampleSettings(8, 2, SIZE, "crop" if framing == "crop" else "whole", "first")
    dataset = CaptureDataset(captures, settings, SEED)
    device = model.encoder.scale_out.bias.device
    for index in range(min(people, len(dataset))):
        sample: TrainingSample = dataset[0, index]
        betas = default_betas(captures.subject(captures.subjects[int(sample.subject)]))
        payload = model.encode(sample.conditioning, betas)
        primitives = model.place(payload.to("cpu"), betas, sample.target.pose).to(device)
        picture = march(primitives, sample.target.camera.to(device))
        image = encode_srgb(picture.rgb).cpu()
        yield image, sample.target.image.float() / 255, sample.conditioning.image[0].float() / 255


class FitRecorder(Recorder):
    """Records PSNR and images of a few subjects."""

    def __init__(
        self,
        config: FitConfig,
        captures: Captures,
        held: Captures | None,
        state: FitState,
        tracker: RunTracker | None = None,
    ) -> None:
        super().__init__(config.steps, config, state)
        self.tracker = tracker
        self.run, self.captures, self.held, self.fit_state = config.run, captures, held, state

    def measured(self) -> dict[str, float]:
        """Return the PSNR of training subjects and of those held out."""
        found = {"psnr_train": measure(self._model(), self.captures)}
        return found if self.held is None else {**found, "psnr_held": measure(self._model(), self.held)}

    def draw(self) -> None:
        """Write a row of images for each subject."""
        path = self.run / PICTURES / f"{self.state.step:07d}.png"
        write_pictures(path, self._model(), self.held or self.captures)

    def append(self, row: Mapping[str, float]) -> None:
        """Append a line to metrics.jsonl."""
        append_metrics(self.run, row)
        if self.tracker is not None:
            self.tracker.log(row, self.state.step)

    def _model(self) -> EncoderModel:
        return EncoderModel(self.fit_state.encoder, {})
