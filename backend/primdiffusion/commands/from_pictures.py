"""Humans from plain pictures: `reconstruct` of pictures, and `fit_posture` of JSON-RPC."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from pathlib import Path

from primdiffusion.capture.photograph import Photograph, read_photographs
from primdiffusion.commands.output import FILES, write_human
from primdiffusion.commands.progress import ReportProgress
from primdiffusion.commands.session import Session
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.formats.answers import FitPostureAnswer, ReconstructAnswer
from primdiffusion.formats.requests import FitPostureRequest, ReconstructRequest
from primdiffusion.formats.whole_files import staged
from primdiffusion.from_pictures import (
    HUMAN_STEPS,
    POSTURE_STEPS,
    Start,
    fit_posture_in,
    human_in,
    outline_overlap,
    start_of,
)
from primdiffusion.machine import peak_memory_gb
from primdiffusion.posture.file import write_posture
from primdiffusion.posture.fit import Posture
from primdiffusion.posture.start import views_of

POSTURE_FILE = "posture.json"
LEAST_OVERLAP = 0.8
"""Intersection over union of the human and the mask; of fits that look right it is above 0.9."""


def reconstruct_pictures(request: ReconstructRequest, session: Session, report: ReportProgress) -> ReconstructAnswer:
    """Write the human and its posture, all files or none; return their paths, warnings and the time taken.

    Raises OSError first of all if the folder cannot be written to; raises as read_photographs, start_of and Session.
    """
    began = time.perf_counter()
    with staged(request.out_dir) as folder:
        model, photographs, start, warnings = _read(request, session, report)
        posture, coefficients = start.posture, None
        on_step = _steps(report, HUMAN_STEPS + (POSTURE_STEPS if request.refine else 0))
        if request.refine:
            posture, coefficients = fit_posture_in(model, photographs, start, on_step)
        elif not start.complete:
            raise ValueError("without refining, a pose file and cameras are needed: give both, or refine")
        human = human_in(model, photographs, posture, coefficients, request.seed, on_step)
        warnings += _doubts(model, photographs, posture)
        report("write", 0, 1, None)
        write_human(folder, human, request.size)
        _write_posture(folder / POSTURE_FILE, photographs, posture)
        report("write", 1, 1, 0.0)  # the last chance to cancel
    return ReconstructAnswer(
        **FILES.in_folder(request.out_dir),
        posture=request.out_dir / POSTURE_FILE,
        seed=request.seed,
        warnings=warnings,
        seconds=round(time.perf_counter() - began, 3),
        peak_gb=round(peak_memory_gb(), 3),
    )


def fit_posture(request: FitPostureRequest, session: Session, report: ReportProgress) -> FitPostureAnswer:
    """Write posture.json, whole or not at all. Raises as `reconstruct_pictures`."""
    began = time.perf_counter()
    with staged(request.out_dir) as folder:
        model, photographs, start, warnings = _read(request, session, report)
        posture, _ = fit_posture_in(model, photographs, start, _steps(report, POSTURE_STEPS))
        warnings += _doubts(model, photographs, posture)
        _write_posture(folder / POSTURE_FILE, photographs, posture)
    seconds = round(time.perf_counter() - began, 3)
    return FitPostureAnswer(posture=request.out_dir / POSTURE_FILE, seconds=seconds, warnings=warnings)


def _read(
    request: ReconstructRequest | FitPostureRequest, session: Session, report: ReportProgress
) -> tuple[DiffusionModel, list[Photograph], Start, list[str]]:
    report("read", 0, 1, None)
    photographs = read_photographs(request.pictures, request.masks)
    report("load", 0, 1, None)
    model = session.model(request.checkpoint)
    start = start_of(photographs, model, request.pose, request.cameras)
    warnings = []
    if len(photographs) == 1 and isinstance(request, ReconstructRequest):
        warnings.append("only one picture: the sides that it does not show are guessed")
    if request.pose is None:
        warnings.append("no pose was given: the person is taken to stand upright, facing the camera")
    return model, photographs, start, warnings


def _steps(report: ReportProgress, total: int) -> Callable[[], None]:
    done = itertools.count(1)
    return lambda: report("fit", next(done), total, None)


def _doubts(model: DiffusionModel, photographs: list[Photograph], posture: Posture) -> list[str]:
    overlap = outline_overlap(model, photographs, posture)
    if overlap >= LEAST_OVERLAP:
        return []
    return [
        f"the fitted body and the masks overlap by {100 * overlap:.0f} %: the pose was probably not found; give a pose "
        "file that is nearer"
    ]


def _write_posture(path: Path, photographs: list[Photograph], posture: Posture) -> None:
    write_posture(path, posture.pose, posture.betas, views_of(photographs, posture.camera))
