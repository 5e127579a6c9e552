"""A human from pictures or captures: `reconstruct`, `fit_posture` and `refine`."""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from torch import Tensor

from primdiffusion.capture.conditioning import (
    CapturedPerson,
    captured_person,
    choose_subject,
    conditioning_views,
    default_betas,
)
from primdiffusion.capture.photograph import Photograph, read_photographs
from primdiffusion.capture.reader import Captures
from primdiffusion.commands.options import RefineCommand
from primdiffusion.commands.output import FILES, write_human
from primdiffusion.commands.progress import ReportProgress, print_warnings
from primdiffusion.commands.session import Session
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.encoder.model import EncoderModel
from primdiffusion.formats.answers import FitPostureAnswer, ReconstructAnswer
from primdiffusion.formats.requests import FitPostureRequest, ReconstructRequest
from primdiffusion.formats.whole_files import staged
from primdiffusion.from_pictures import (
    POSTURE_STEPS,
    Start,
    fit_posture_in,
    human_in,
    human_steps,
    outline_overlap,
    start_of,
)
from primdiffusion.human import Human
from primdiffusion.human_file import load_human
from primdiffusion.machine import peak_memory_gb
from primdiffusion.posture.file import write_posture
from primdiffusion.posture.fit import Posture
from primdiffusion.posture.start import views_of
from primdiffusion.reconstruction import reconstruct as reconstruct_human
from primdiffusion.reconstruction import reconstruct_by_prior
from primdiffusion.render.descent import DescentSettings
from primdiffusion.training.refine import bare_body, meshed_person, refine, view_psnr

STAGES = 4
"""Load, read, encode, write."""
ENCODER_VIEWS = 8
"""Images to encode for a start from the encoder."""
POSTURE_FILE = "posture.json"
LEAST_OVERLAP = 0.8
"""Intersection over union of the human and the mask; of fits that look right it is above 0.9."""


def reconstruct(request: ReconstructRequest, session: Session, report: ReportProgress) -> ReconstructAnswer:
    """Write the human, all files or none; return their paths, the views used and the time taken.

    Raises OSError first of all if the folder cannot be written to; raises as captured_person and load_encoder.
    """
    if request.pictures:
        return reconstruct_pictures(request, session, report)
    assert request.capture is not None, "checked by the request"
    began = time.perf_counter()
    with staged(request.out_dir) as folder:
        report("load", 0, STAGES, None)
        model = session.encoder(request.checkpoint) if request.by == "encoder" else session.model(request.checkpoint)
        report("read", 1, STAGES, None)
        body = model.body if isinstance(model, EncoderModel) else None
        person = captured_person(request.capture, request.subject, request.frame, request.views, body)
        report("encode", 2, STAGES, None)
        loaded = time.perf_counter()
        if isinstance(model, EncoderModel):
            human = reconstruct_human(model, person)
        else:
            on_step = lambda done, total: report("fit", done, total, None)  # noqa: E731
            human = reconstruct_by_prior(model, person, on_step, request.seed)
        encoded = time.perf_counter()
        report("write", 3, STAGES, None)
        write_human(folder, human, request.size)
        report("write", STAGES, STAGES, 0.0)  # the last chance to cancel
    return ReconstructAnswer(
        **FILES.in_folder(request.out_dir),
        subject=person.subject,
        frame=person.frame,
        views=list(person.cameras),
        warnings=list(person.warnings),
        seconds=round(time.perf_counter() - began, 3),
        seconds_encoding=round(encoded - loaded, 3),
        peak_gb=round(peak_memory_gb(), 3),
    )


def refine_human(command: RefineCommand, session: Session, report: ReportProgress) -> None:
    """Refine; print the folder and the PSNR before and after.

    Raises:
        ValueError, FileNotFoundError: captures, start or settings are missing, damaged or do not match; OSError.
    """
    settings = DescentSettings(command.steps, seconds=60 * command.minutes, seed=command.seed)
    with staged(command.out) as folder:
        captures, name = choose_subject(command.capture, command.subject)
        person = captures.subject(name)
        betas = default_betas(person)
        held, given = split_cameras(len(person.views), command.hold_out_cameras)
        frames = range(person.frames)
        views = [conditioning_views(captures, name, frame, given, command.size) for frame in frames]
        held_out = [conditioning_views(captures, name, frame, held, command.size) for frame in frames if held]
        human = _start(command, session, captures, name, betas, given).to(session.device)
        done = itertools.count(1)
        refined = refine(human, views, settings, lambda _: report("refine", next(done), command.steps, None))
        write_human(folder, refined.human, command.size)
    seconds = f"{refined.steps} steps, {refined.seconds:.1f} s"
    print(f"{command.out}  {name}, {person.frames} frames, {len(given)} cameras, {seconds}")
    print(f"given views     {refined.psnr_before:.2f} -> {refined.psnr_after:.2f} dB")
    if held:
        before, after = (float(view_psnr(one, held_out).mean()) for one in (human, refined.human))
        print(f"held-out views  {before:.2f} -> {after:.2f} dB (cameras {', '.join(map(str, held))})")
        if after < before:
            print_warnings(["the held-out PSNR decreased: use more views"])
    if refined.steps < command.steps:
        print_warnings([f"the time limit of {command.minutes:g} minutes was reached after {seconds}"])


def _start(
    command: RefineCommand, session: Session, captures: Captures, name: str, betas: Tensor, given: Sequence[int]
) -> Human:
    """Return the initial human with the subject's betas."""
    if command.start == "body":
        human = bare_body(betas)
    elif command.start == "encoder":
        cameras = tuple(given[:: math.ceil(len(given) / ENCODER_VIEWS)])
        views = conditioning_views(captures, name, 0, cameras)
        human = reconstruct_human(
            session.encoder(command.checkpoint), CapturedPerson(name, 0, cameras, views, betas, ())
        )
    elif command.start.endswith(".glb"):
        human = meshed_person(command.start)
    else:
        human = load_human(command.start)
    if human.body_setup is not None:
        raise ValueError(
            f"{command.start} uses the body {human.body_setup.files.smpl.path}, but captures are fitted to the "
            "default body: start from a human on the default body, or from the encoder"
        )
    return dataclasses.replace(human, betas=betas, provenance={**human.provenance, "refined_from": name})


def split_cameras(count: int, held: int) -> tuple[list[int], list[int]]:
    """Split `count` cameras into `held` evenly spaced ones to hold out and the others; return both as indices.

    Raises ValueError if no other would be left.
    """
    if not 0 <= held < count:
        raise ValueError(f"{held} of {count} cameras cannot be held out: choose 0 to {count - 1}")
    out = [int((place + 0.5) * count / held) for place in range(held)]
    return out, [camera for camera in range(count) if camera not in out]


def reconstruct_pictures(request: ReconstructRequest, session: Session, report: ReportProgress) -> ReconstructAnswer:
    """Write the human and its posture, all files or none; return their paths, warnings and the time taken.

    Raises OSError first of all if the folder cannot be written to; raises as read_photographs, start_of and Session.
    """
    began = time.perf_counter()
    with staged(request.out_dir) as folder:
        model, photographs, start, warnings = _read(request, session, report)
        posture = start.posture
        on_step = _steps(report, human_steps(model) + (POSTURE_STEPS if request.refine else 0))
        if request.refine:
            posture = fit_posture_in(model, photographs, start, on_step)
        elif not start.complete:
            raise ValueError("without refining, a pose file and cameras are needed: give both, or refine")
        human = human_in(model, photographs, posture, request.seed, on_step)
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
        posture = fit_posture_in(model, photographs, start, _steps(report, POSTURE_STEPS))
        warnings += _doubts(model, photographs, posture)
        _write_posture(folder / POSTURE_FILE, photographs, posture)
    seconds = round(time.perf_counter() - began, 3)
    return FitPostureAnswer(posture=request.out_dir / POSTURE_FILE, seconds=seconds, warnings=warnings)


def _read(
    request: ReconstructRequest | FitPostureRequest, session: Session, report: ReportProgress
) -> tuple[DiffusionModel, list[Photograph], Start, list[str]]:
    report("read", 0, 1, None)
    photographs = read_photographs(request.pictures, request.masks, mask_label=request.mask_label)
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
