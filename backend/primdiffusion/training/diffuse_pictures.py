"""What a run of stage 2 looks like as it goes: a few people of the same seeds, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.formats import requests
from primdiffusion.geometry.srgb import encode_srgb
from primdiffusion.human import framing, generate_batch, place
from primdiffusion.render.march import MarchSettings, march
from primdiffusion.staging import written_whole

SEEDS = (0, 1, 2, 3)
WIDTH, HEIGHT = 256, 256
YAW = 0.4
"""Radians."""
STEP = 0.006
"""Metres between samples of a ray."""


@torch.no_grad()
def write_samples(path: Path, model: DiffusionModel, seeds: Sequence[int] = SEEDS, steps: int = requests.STEPS) -> None:
    """People of `seeds` from a little to their left, over black. Raises OSError where there is no room."""
    pictures = []
    for human in generate_batch(model, seeds, steps):
        primitives = place(human)
        camera = framing(primitives, YAW, WIDTH, HEIGHT).to(model.device)
        rendering = march(primitives.to(model.device), camera, MarchSettings(step=STEP))
        pictures.append(encode_srgb(rendering.rgb.clamp(0, 1)).cpu())
    picture = (torch.cat(pictures, dim=1) * 255).round().to(torch.uint8).numpy()
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as unfinished:
        Image.fromarray(np.ascontiguousarray(picture)).save(unfinished, format="PNG")
