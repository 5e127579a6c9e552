"""Runs of stage 1 that take seconds: boxes for people, few pixels, an encoder of few channels."""

import contextlib
import dataclasses
import itertools
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from accelerate.state import AcceleratorState
from capture_scenes import body_mesh
from PIL import Image
from primdiffusion.cli import main
from primdiffusion.encoder.config import PRESETS
from primdiffusion.geometry.textured_mesh import TexturedMesh
from primdiffusion.training import fit as fit_module
from primdiffusion.training.fit import MODEL
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.loop import Interrupt
from primdiffusion.training.run_folder import METRICS
from support.runs import rows
from support.tiny import TINY

STATE = "state.safetensors"
FEW = {"steps": 6, "batch": 1, "views": 2, "targets": 1, "size": 16, "step": 0.02, "hold_scale": 2, "log_every": 1}
WHOLE = {".lock", "config.json", "run.json", METRICS, MODEL, STATE, "pictures"}
"""What lies in the folder of a run that was not torn."""


def make_small(patch: pytest.MonkeyPatch) -> None:
    """The default encoder becomes a tiny one, and what is measured small."""
    patch.setitem(PRESETS, "default", dataclasses.replace(TINY, appearance="texels"))
    patch.setattr(fit_module, "SIZE", 24)
    patch.setattr(fit_module, "PEOPLE", 2)
    forget_processes()


def forget_processes() -> None:
    """accelerate keeps the precision of a process' first run."""
    AcceleratorState._reset_state(reset_partial_state=True)


def stop_after(steps: int) -> contextlib.AbstractContextManager:
    """Interrupt runs after so many steps."""
    return mock.patch.object(Interrupt, "due", side_effect=(asked >= steps for asked in itertools.count()))


def settings(data: Path, run: Path, **changes) -> FitConfig:
    """Six quick steps."""
    return FitConfig(data=data, run=run, **{**FEW, "threads": 1, "learning_rate": 1e-4, **changes})


def logged(run: Path) -> list[int]:
    """Steps of the lines that tell the loss."""
    return [row["step"] for row in rows(run) if "rgb" in row]


def files(run: Path) -> set[str]:
    """What lies in a run's folder."""
    return {path.name for path in run.iterdir()}


def flags(config: FitConfig) -> list[str]:
    """A command line for it, as far as it is of `settings`."""
    names = ("data", "run", *FEW, "threads", "learning_rate", "save_every")
    return [f"--{name.replace('_', '-')}={getattr(config, name)}" for name in names]


def patched_person() -> TexturedMesh:
    """The default body in patches of colours that fade into each other."""
    draws = np.random.default_rng(0).integers(60, 190, (12, 12, 4), np.uint8)
    draws[..., 3] = 255
    texture = Image.fromarray(draws).resize((256, 256), Image.Resampling.BICUBIC)
    return body_mesh(texture)


if __name__ == "__main__":  # a run in a process of its own, that a test may kill
    make_small(pytest.MonkeyPatch())
    main()
