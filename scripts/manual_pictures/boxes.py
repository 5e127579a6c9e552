"""Draws a person on a much heavier body: with boxes that keep their size, as in the paper, and with boxes that grow."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from primdiffusion.body.model import betas_of_measures, default_body
from primdiffusion.diffusion.checkpoint import load_checkpoint
from primdiffusion.editing.reshaping import reshape_human
from primdiffusion.geometry.camera import look_at
from primdiffusion.geometry.image import encode_srgb
from primdiffusion.human import Human, generate, place
from primdiffusion.render.march import march

from .shrink import save_jpeg

SEED = 10
HEIGHT_M, WEIGHT_KG = 1.70, 95.0
SIZE = 420
_GREY = (0.35, 0.35, 0.35)


def boxes(out: Path) -> None:
    """Generate, reshape, and draw both side by side."""
    human = generate(load_checkpoint(), SEED)
    betas = betas_of_measures(human.betas, torch.eye(10), default_body(), HEIGHT_M, WEIGHT_KG).float()
    of_the_paper = dataclasses.replace(human, betas=betas)
    pictures = [_torso(person) for person in (of_the_paper, reshape_human(human, betas))]
    save_jpeg(Image.fromarray(np.concatenate(pictures, 1)), out)


def _torso(human: Human) -> np.ndarray:
    eye, target = torch.tensor([0.8, 0.1, 1.5]), torch.tensor([0.0, 0.1, 0.0])
    camera = look_at(eye, target, vertical_fov=math.radians(32), width=SIZE, height=SIZE)
    colours = encode_srgb(march(place(human), camera).over(_GREY).clamp(0, 1))
    return (colours * 255).round().byte().numpy()
