"""A human from plain pictures: what is known of pose, shape and camera is refined, then appearance is fitted.

The two take turns from coarse to fine: the mean human finds the pose roughly by its outline, the person coefficients
that then explain the pictures (`reconstruction`) give it the colours by which limbs find their places.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from primdiffusion.capture.dataset import Views
from primdiffusion.capture.photograph import Photograph, rgba_of
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.formats.camera_rig import View
from primdiffusion.human import Human, made_by
from primdiffusion.reconstruction.from_captures import FIT_STEPS, PersonComponents, targets_of
from primdiffusion.reconstruction.posture_file import read_cameras, read_posture
from primdiffusion.reconstruction.posture_fit import Posture, PostureFit, Stage, outline_error, overlap
from primdiffusion.reconstruction.posture_start import (
    STANDING_ARMS,
    before_cameras,
    cameras_of,
    framed,
    repeated,
    standing,
    turned_to_camera,
)
from primdiffusion.render.inverse import TargetImage


class Round(NamedTuple):
    """A stage of the posture and the steps of Gauss-Newton on coefficients after it, both in pictures of one size."""

    side: int
    stage: Stage
    coefficient_steps: int


ROUNDS = (Round(96, Stage(60, 0.04), 2), Round(96, Stage(80, 0.02), 2), Round(192, Stage(60, 0.01), 0))
POSTURE_STEPS = sum(each.stage.steps + each.coefficient_steps for each in ROUNDS)
OUTLINE_SIDE = 64
"""Of the pictures that choose a standing body's arms."""
POSE_FILE_TIGHTNESS = 2.0
"""Poses of files are known twice as well as a standing body."""


@dataclasses.dataclass(frozen=True, eq=False)
class Start:
    """What is known before pictures are looked at."""

    posture: Posture
    """With cameras of the squares that are kept of pictures."""
    tightness: float
    """See `PostureFit`."""
    complete: bool
    """Pose and cameras are those of files."""


def start_of(
    photographs: Sequence[Photograph],
    model: DiffusionModel,
    pose_path: Path | None = None,
    cameras_path: Path | None = None,
) -> Start:
    """The posture to start from: of the files given, else of a standing body, seen as large as in the pictures.

    Raises FileNotFoundError, and ValueError for files that are no poses or cameras, or not one for each picture.
    """
    sizes = [(photograph.width, photograph.height) for photograph in photographs]
    views = None if cameras_path is None else read_cameras(cameras_path, sizes)
    if pose_path is None:
        return Start(_standing(photographs, model, views), 1.0, complete=False)
    known = read_posture(pose_path, sizes)
    pose = repeated(known.pose, len(photographs))
    betas = model.shapes.bias.clone() if known.betas is None else known.betas
    views = known.views if views is None else views
    if views is None:
        pose = turned_to_camera(pose)
        camera = framed(photographs, pose, betas, [photograph.lens() for photograph in photographs])
    else:
        camera = cameras_of(photographs, views)
    return Start(Posture(pose, betas, camera), POSE_FILE_TIGHTNESS, complete=views is not None)


def _standing(photographs: Sequence[Photograph], model: DiffusionModel, views: Sequence[View] | None) -> Posture:
    """The standing body whose arms fit the outline best."""
    components, betas = PersonComponents.of(model), model.shapes.bias.clone()
    payload = components.payload(components.coefficients(components.everyone()))
    lenses = [photograph.lens() for photograph in photographs] if views is None else views
    found = []
    for arms in STANDING_ARMS:
        pose = standing(len(photographs), arms)
        found.append(Posture(pose, betas, framed(photographs, pose, betas, lenses)))
    best = min(found, key=lambda one: outline_error(payload, _targets(photographs, one, OUTLINE_SIDE)))
    return best if views is None else before_cameras(best, cameras_of(photographs, views))


def fit_posture_in(
    model: DiffusionModel, photographs: Sequence[Photograph], start: Start, on_step: Callable[[], None]
) -> Posture:
    """The posture in the pictures; deterministic.

    `on_step` is called POSTURE_STEPS times. Raises ValueError as `PersonComponents.of`.
    """
    components = PersonComponents.of(model)
    fit, people = PostureFit(start.posture, model.shapes, start.tightness), components.everyone()
    for side, stage, coefficient_steps in ROUNDS:
        payload = components.payload(components.coefficients(people))
        fit.refine(payload, _targets(photographs, fit.posture(), side), stage, on_step)
        targets = _targets(photographs, fit.posture(), side)
        for _ in range(coefficient_steps):
            people = components.closer(people, targets)
            on_step()
    return fit.posture()


def human_steps(model: DiffusionModel) -> int:
    """How often `human_in` reports."""
    return PersonComponents.of(model).start_steps + FIT_STEPS


def human_in(
    model: DiffusionModel,
    photographs: Sequence[Photograph],
    posture: Posture,
    seed: int | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> Human:
    """The human in pictures whose posture is known, on the CPU; `on_step` is called `human_steps` times.

    With a seed, what no picture shows is drawn instead of the most probable. Raises ValueError as
    `PersonComponents.of`.
    """
    components, views, frames = PersonComponents.of(model), _views(photographs, posture), posture.frames()
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    people = components.start(views, frames, on_step)
    payload = components.fit(views, frames, people, on_step, generator)
    names = [photograph.path.name for photograph in photographs]
    origin: dict[str, Any] = {"reconstructed_from": names} | ({} if seed is None else {"seed": seed})
    return Human(payload, posture.betas, {**origin, **made_by(model)}).validate()


def outline_overlap(model: DiffusionModel, photographs: Sequence[Photograph], posture: Posture) -> float:
    """Intersection over union of the mean human in the posture and the masks."""
    components = PersonComponents.of(model)
    targets = _targets(photographs, posture, ROUNDS[0].side)
    return overlap(components.payload(components.coefficients(components.everyone())), targets)


def _views(photographs: Sequence[Photograph], posture: Posture) -> Views:
    return Views(rgba_of(photographs), posture.camera, posture.pose)


def _targets(photographs: Sequence[Photograph], posture: Posture, side: int) -> list[TargetImage]:
    return targets_of(_views(photographs, posture), posture.frames(), side)
