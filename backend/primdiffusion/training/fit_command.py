"""The command `primdiffusion fit`: training of stage 1; on many devices by `accelerate launch -m primdiffusion fit`."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import tyro

from primdiffusion.training.fit import MODEL, fit
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.fit_perceptual import load_perceptual


def run(arguments: Sequence[str]) -> None:
    """Parses and runs one line; prints where the encoder is. Raises what `fit` does."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    config = tyro.cli(FitConfig, args=arguments, prog="primdiffusion fit")
    weights = config.loss.perceptual_weights
    model = fit(config, load_perceptual(weights) if config.loss.perceptual and weights is not None else None)
    print(f"{config.run / MODEL}  {model.card['steps']} of {config.steps} steps")
