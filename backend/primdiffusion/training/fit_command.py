"""The command `primdiffusion fit`: training of stage 1; on many devices by `accelerate launch -m primdiffusion fit`."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import tyro
from accelerate import PartialState

from primdiffusion.training.fit import fit
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.fit_folder import MODEL


def run(arguments: Sequence[str]) -> None:
    """Parses and runs one line; prints where the encoder is. Raises what `fit` does."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    config = tyro.cli(FitConfig, args=arguments, prog="primdiffusion fit")
    model = fit(config)
    if PartialState().is_main_process:
        print(f"{config.run / MODEL}  {model.card['steps']} of {config.steps} steps")
