"""The job `reconstruct`: captures to a person, with the encoder kept in memory."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch

from primdiffusion.capture.conditioning import captured_person
from primdiffusion.encoder.checkpoint import load_encoder
from primdiffusion.encoder.encode import EncoderModel
from primdiffusion.machine import peak_memory_gb
from primdiffusion.person_folder import FILES, write_person
from primdiffusion.reconstruction import reconstruct
from primdiffusion.serve.drawing import Report
from primdiffusion.serve.params import ReconstructParams
from primdiffusion.staging import staged

STEPS = 4
"""Read, load, encode, write."""


class Reconstructor:
    """Keeps the encoder of the last job."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._loaded: tuple[str | None, EncoderModel] | None = None

    def reconstruct(self, params: ReconstructParams, report: Report) -> dict[str, Any]:
        """Writes the person to `out_dir`, all files or none; returns their paths, what was seen and what it took.

        Raises OSError before any work if the folder cannot be written to; what captured_person and load_encoder raise.
        """
        began = time.perf_counter()
        out = Path(params.out_dir)
        with staged(out) as folder:
            report("read", 0, STEPS, None)
            person = captured_person(params.capture, params.subject, params.frame, params.views)
            report("load", 1, STEPS, None)
            model = self._model(params.checkpoint)
            report("encode", 2, STEPS, None)
            loaded = time.perf_counter()
            human = reconstruct(model, person)
            encoded = time.perf_counter()
            report("write", 3, STEPS, None)
            write_person(folder, human, params.size)
            report("write", STEPS, STEPS, 0.0)  # the last chance to cancel
        return {
            **FILES.in_folder(out),
            "subject": person.subject,
            "frame": person.frame,
            "views": list(person.cameras),
            "warnings": list(person.warnings),
            "seconds": round(time.perf_counter() - began, 3),
            "seconds_encoding": round(encoded - loaded, 3),
            "peak_gb": round(peak_memory_gb(), 3),
        }

    def _model(self, checkpoint: str | None) -> EncoderModel:
        if self._loaded is None or self._loaded[0] != checkpoint:
            self._loaded = None  # frees the old one first
            path = None if checkpoint is None else Path(checkpoint)
            self._loaded = (checkpoint, load_encoder(path, self._device))
        return self._loaded[1]
