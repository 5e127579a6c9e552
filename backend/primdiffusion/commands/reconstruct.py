"""A human from pictures or captures: `reconstruct`, `fit_posture` and `refine`."""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from PIL import Image
from torch import Tensor

from primdiffusion.capture.conditioning import (
    CapturedPerson,
    captured_person,
    choose_subject,
    conditioning_views,
    default_betas,
)
from primdiffusion.capture.reader import Captures
from primdiffusion.commands.options import RefineCommand
from primdiffusion.commands.output import FILES, draw_back, variation_files, write_files, write_human
from primdiffusion.commands.progress import ReportProgress, print_warnings
from primdiffusion.commands.session import Session
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.encoder.model import EncoderModel
from primdiffusion.files.whole_files import atomic_folder
from primdiffusion.formats.answers import FitPostureAnswer, ReconstructAnswer, VariationFiles
from primdiffusion.formats.requests import FitPostureRequest, Pictures, ReconstructRequest
from primdiffusion.human import Human
from primdiffusion.human_file import load_human
from primdiffusion.reconstruction.from_captures import HUMAN_STEPS, draw_humans, steps_of
from primdiffusion.reconstruction.from_captures import reconstruct as reconstruct_human
from primdiffusion.reconstruction.from_pictures import POSTURE_STEPS, person_in_pictures
from primdiffusion.reconstruction.posture_start import write_posture
from primdiffusion.render.descent import DescentSettings
from primdiffusion.training.refine import bare_body, refine, view_psnr

STAGES = 4
"""Load, read, encode, write."""
ENCODER_VIEWS = 8
"""Images to encode for a start from the encoder."""
START_WORK, FIT_WORK = 4, 15
"""Work of a step of `PriorFit.start` and of `PriorFit.fit`; that of a step of the posture is 1."""
SURE_AFTER_S = 3.0
"""Seconds until the time left is reported; the first steps compile."""
POSTURE_FILE, MASK_FILE = "posture.json", "mask.png"


def reconstruct(request: ReconstructRequest, session: Session, report: ReportProgress) -> ReconstructAnswer:
    """Open the pictures, refine the pose unless it is known, fit a human, and write its files, all or none.

    Raises OSError first of all if the folder cannot be written to; raises as Session, person_in_pictures and
    captured_person.
    """
    began, warnings = time.perf_counter(), []
    with atomic_folder(request.out_dir) as folder:
        report("load", 0, STAGES, None)
        by_encoder = request.capture is not None and request.by == "encoder"
        model = session.encoder(request.checkpoint) if by_encoder else session.model(request.checkpoint)
        on_step = _steps(report, request.refine and bool(request.pictures), steps_of(model), 1 + request.backs)
        if request.capture is None:
            report("read", 0, STAGES, None)
            model = session.model(request.checkpoint)
            person = person_in_pictures(model, *_files(request), refine=request.refine, on_step=on_step)
            _write_found(folder, person)
            if len(request.pictures) == 1 and not request.backs:
                warnings.append("only one picture: the sides that it does not show are guessed")
        else:
            report("read", 1, STAGES, None)
            body = model.body if isinstance(model, EncoderModel) else None
            person = captured_person(request.capture, request.subject, request.frame, request.views, body)
            report("encode", 2, STAGES, None)
        backs = _backs(request, folder)
        if backs and isinstance(model, DiffusionModel):
            human, *others = draw_humans(model, person, (request.seed, *(back.seed for back in backs)), on_step)
        else:
            human, others = reconstruct_human(model, person, request.seed, on_step), []
        report("write", STAGES if request.pictures else 3, STAGES, None)
        write_human(folder, human, request.size)
        for files, other in zip(backs, others, strict=True):
            write_files(files.person, other)
            draw_back(files.picture, other, request.size)
        report("write", STAGES, STAGES, 0.0)  # the last chance to cancel
    of_capture = {} if person.frame is None else {"subject": person.subject, "views": list(person.cameras)}
    return ReconstructAnswer(
        **FILES.in_folder(request.out_dir),
        **of_capture,
        frame=person.frame,
        posture=None if request.capture else request.out_dir / POSTURE_FILE,
        fit=None if person.fit is None else person.fit["percent"],
        backs=_backs(request, request.out_dir),
        seed=request.seed,
        warnings=[*warnings, *person.warnings],
        seconds=round(time.perf_counter() - began, 3),
    )


def _backs(request: ReconstructRequest, folder: Path) -> list[VariationFiles]:
    first = 0 if request.seed is None else request.seed + 1
    return [variation_files(folder, seed) for seed in range(first, first + request.backs)]


def fit_posture(request: FitPostureRequest, session: Session, report: ReportProgress) -> FitPostureAnswer:
    """Write posture.json, whole or not at all. Raises as `reconstruct`."""
    began = time.perf_counter()
    with atomic_folder(request.out_dir) as folder:
        report("load", 0, 1, None)
        model = session.model(request.checkpoint)
        report("read", 0, 1, None)
        person = person_in_pictures(model, *_files(request), on_step=_steps(report, True))
        _write_found(folder, person)
    seconds, warnings = round(time.perf_counter() - began, 3), list(person.warnings)
    fit = None if person.fit is None else person.fit["percent"]
    return FitPostureAnswer(posture=request.out_dir / POSTURE_FILE, fit=fit, seconds=seconds, warnings=warnings)


def refine_human(command: RefineCommand, session: Session, report: ReportProgress) -> None:
    """Refine; print the folder and the PSNR before and after.

    Raises:
        ValueError, FileNotFoundError: captures, start or settings are missing, damaged or do not match; OSError.
    """
    settings = DescentSettings(command.steps, seed=command.seed)
    with atomic_folder(command.out) as folder:
        captures, name = choose_subject(command.capture, command.subject)
        person = captures.subject(name)
        betas = default_betas(person)
        held, given = split_cameras(len(person.views), command.hold_out_cameras)
        frames = range(person.frames)
        views = [conditioning_views(captures, name, frame, given, command.size) for frame in frames]
        held_out = [conditioning_views(captures, name, frame, held, command.size) for frame in frames if held]
        human = _start(command, session, captures, name, betas, given).to(session.device)
        done = itertools.count(1)
        refined = refine(human, views, settings, lambda: report("refine", next(done), command.steps, None))
        write_human(folder, refined.human, command.size)
    print(f"{command.out}  {name}, {person.frames} frames, {len(given)} cameras, {command.steps} steps")
    print(f"given views     {refined.psnr_before:.2f} -> {refined.psnr_after:.2f} dB")
    if held:
        before, after = (float(view_psnr(one, held_out).mean()) for one in (human, refined.human))
        print(f"held-out views  {before:.2f} -> {after:.2f} dB (cameras {', '.join(map(str, held))})")
        if after < before:
            print_warnings(["the held-out PSNR decreased: use more views"])


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


def _write_found(folder: Path, person: CapturedPerson) -> None:
    """posture.json, and mask.png of a picture that had no mask."""
    write_posture(folder / POSTURE_FILE, person.views.pose, person.betas, person.whole_views, person.fit)
    for mask in person.masks_made:
        Image.fromarray(mask).save(folder / MASK_FILE)


def _files(request: Pictures) -> tuple[Any, ...]:
    return request.pictures, request.masks, request.mask_label, request.pose, request.cameras


def _steps(report: ReportProgress, posture: bool, others: int = 0, humans: int = 0) -> Callable[[], None]:
    """Return a function to call after each step, which reports the work done and the seconds left.

    `others`: `steps_of` the model, of which HUMAN_STEPS are repeated for each of the `humans`.
    """
    work = [1] * (POSTURE_STEPS if posture else 0)
    work += [START_WORK] * (others - HUMAN_STEPS) + [FIT_WORK] * (HUMAN_STEPS * humans if others else 0)
    done, began = itertools.accumulate(work), time.perf_counter()

    def on_step() -> None:
        so_far, spent = next(done), time.perf_counter() - began
        left = spent / so_far * (sum(work) - so_far)
        report("fit", so_far, sum(work), round(left, 3) if spent > SURE_AFTER_S else None)

    return on_step
