"""The folder of a run of stage 1: how a run begins or goes on in it, and how it is saved."""

from __future__ import annotations

from primdiffusion.capture.reader import Captures
from primdiffusion.encoder.checkpoint import save_encoder
from primdiffusion.encoder.encode import EncoderModel
from primdiffusion.training import run_folder
from primdiffusion.training.fit_config import FitConfig
from primdiffusion.training.fit_state import FitState

STATE, MODEL = "state.safetensors", "encoder.safetensors"


def begin(config: FitConfig, captures: Captures, processes: int) -> None:
    """What `run_folder.begin` does, for these captures; raises what it does."""
    step = FitState.saved_step(config.run / STATE)
    run_folder.begin(
        config,
        captures.subjects,
        {"captures": dict(captures.about)},
        {"step": step, "processes": processes},
        lambda row: row["step"] <= step,
    )


def save(config: FitConfig, state: FitState, model: EncoderModel) -> None:
    """Encoder and state, each whole or as it was. A kill between them leaves an encoder newer than the state.

    Raises:
        CheckpointError, NotFiniteError: weights are not finite; nothing is replaced by them.
        OSError: there is no room.
    """
    save_encoder(config.run / MODEL, model)
    state.save(config.run / STATE)
