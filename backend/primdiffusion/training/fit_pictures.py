"""What a run of stage 1 looks like as it goes: pictures of a few people, and how near they are to their captures."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from primdiffusion.capture.conditioning import default_betas
from primdiffusion.capture.dataset import CaptureDataset, SampleSettings, TrainingSample
from primdiffusion.capture.reader import Captures
from primdiffusion.encoder.encode import EncoderModel
from primdiffusion.evaluation.image_metrics import psnr
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.render.march import march
from primdiffusion.staging import written_whole

SIZE = 256
PEOPLE = 6
SEED = 7


def measure(model: EncoderModel, captures: Captures, people: int = PEOPLE) -> float:
    """Mean PSNR (dB, whole pictures of SIZE pixels a side) of two views of each of a few people, in another pose."""
    found = [psnr(image, target) for image, target, _ in _compared(model, captures, people, "whole")]
    return float(torch.cat(found).mean())


def write_pictures(path: Path, model: EncoderModel, captures: Captures, people: int = PEOPLE) -> None:
    """A row for each person: a given picture, then twice a drawn one and its capture, all but the first in one pose."""
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
    """Of each person two drawn pictures, the captured ones, and one of those given, encoded, on the CPU."""
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
