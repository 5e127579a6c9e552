"""A human from plain pictures: what is known of pose, shape and camera is refined, then appearance is fitted.

The two take turns from coarse to fine: the mean human finds the pose roughly by its outline, the person coefficients
that then explain the pictures (`prior_fit`) give it the colours by which limbs find their places.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import UInt8

from primdiffusion.body.model import BodyPose
from primdiffusion.capture.conditioning import CapturedPerson
from primdiffusion.capture.dataset import stack
from primdiffusion.capture.photograph import Photograph, read_photographs
from primdiffusion.capture.reader import Views, as_camera
from primdiffusion.diffusion.model import DiffusionModel
from primdiffusion.formats.camera_rig import View
from primdiffusion.human import pose_body
from primdiffusion.primitives.primitives import Payload
from primdiffusion.reconstruction.posture_fit import Posture, PostureFit, Stage, each, outline_error, resized
from primdiffusion.reconstruction.posture_masks import cut_by_outline, load_opencv, outline_in, without_things
from primdiffusion.reconstruction.posture_quality import FitQuality, colour_error, quality_of
from primdiffusion.reconstruction.posture_start import (
    STANCES,
    cameras_of,
    framed,
    place_in_camera,
    read_cameras,
    read_posture,
    repeated,
    standing,
    turned_to_camera,
    views_of,
)
from primdiffusion.reconstruction.prior_fit import PriorFit, targets_of
from primdiffusion.render.image import PosedView


class FitStage(NamedTuple):
    """A refinement of the posture and the Gauss-Newton steps on coefficients after it, both in pictures of one size."""

    side: int
    refinement: Stage
    coefficient_steps: int


FIT_STAGES = (
    FitStage(96, Stage(12, 0.04, upright=False), 0), FitStage(96, Stage(28, 0.03, upright=False), 2),
    FitStage(96, Stage(50, 0.02), 2), FitStage(192, Stage(40, 0.01), 0),
)  # fmt: skip
POSTURE_STEPS = sum(each.refinement.steps + each.coefficient_steps for each in FIT_STAGES)
OUTLINE_SIDE = 64
"""Side of the pictures that choose the stance of a standing body, pixels."""
LIKELY_START, LIKELY = 1.8, 1.5
"""Largest ratio of an outline's error to the least for a turn to be tried, and to be kept after the first stage."""
STANCES_TRIED, STANCE_BLUR = 3, 0.03
"""Number of stances tried in a single picture, and blur, as a share of its side, after which the first stage keeps the
one whose outline is best: an arm beside the true one is better than none."""
OWN_COLOURS = Stage(20, 0.03, upright=False)
"""Refinement by the colours of each turn, before colours decide on turns: limbs find their places."""
TURN_STEPS = 3
"""Gauss-Newton steps on coefficients before it."""
OUTLINE_IN_PICTURE = 256
"""Largest side of the drawing of a body over a picture without a mask, pixels."""
CUT_OFF = 0.05
"""Least length of a body below its mask, as a share of the mask's height, at which its legs are cut off."""
POSE_FILE_PRECISION = 4.0
"""Prior precision of poses of files: half the standard deviations of a standing body."""


@dataclasses.dataclass(frozen=True, eq=False)
class InitialPose:
    """The posture that is known before pictures are looked at."""

    posture: Posture
    """Poses to try, with cameras of the squares that are kept of pictures."""
    pictures: Sequence[int]
    """The picture of each pose; a picture may have several, of which one is right."""
    prior_precision: float
    """See `PostureFit`."""
    complete: bool
    """Whether pose and cameras are from files."""
    tilted: bool
    """See `PostureFit`."""
    stated: Sequence[bool]
    """Whether each lens is known, by EXIF or a file of cameras."""


class Found(NamedTuple):
    """The result of a fit to pictures."""

    posture: Posture
    photographs: Sequence[Photograph]
    """The pictures, without the parts of their masks that are not the person."""


def person_in_pictures(
    model: DiffusionModel,
    pictures: Sequence[str | Path],
    masks: Sequence[str | Path] = (),
    mask_label: int | None = None,
    pose: str | Path | None = None,
    cameras: str | Path | None = None,
    *,
    refine: bool = True,
    on_step: Callable[[], None] = lambda: None,
) -> CapturedPerson:
    """The person in plain pictures, for `reconstruct`; the fields of `requests.Pictures` say what the files are.

    Pose, shape and cameras are refined from those of the files, or of a standing body; otherwise both files are needed.
    A single picture that has neither alpha nor a mask is cut out by the outline of the body, if the pose file has its
    camera. `on_step` is called POSTURE_STEPS times while refining; an exception that it raises cancels. Deterministic.

        >>> person = pd.person_in_pictures(model, ["anna.png"])
        >>> person.betas.shape
        torch.Size([10])

    Raises FileNotFoundError, FileError and ValueError, as `read_photographs`, `initial_pose` and `PriorFit.of`.
    """
    pose, cameras = (None if path is None else Path(path) for path in (pose, cameras))
    photographs = read_photographs(
        list(map(Path, pictures)),
        list(map(Path, masks)),
        mask_label=mask_label,
        outline=None if pose is None or len(pictures) > 1 else lambda *size: _body_in(model, pose, cameras, size),
    )
    start, warnings = initial_pose(photographs, model, pose, cameras), []
    if refine:
        found = fit_posture_in(model, photographs, start, on_step)
    elif not start.complete:
        raise ValueError("without refining, a pose file and cameras are needed: give both, or refine")
    else:
        found = Found(start.posture, _cut_out_twice(model, photographs, start.posture))
    if pose is None:
        facing = ", facing the camera" if len(photographs) == 1 else ""
        warnings.append(f"no pose was given: the person is taken to stand upright{facing}")
    quality = fit_quality(model, photographs, found)
    masks_made = tuple(one.whole_mask() for one in found.photographs if one.uncut is not None)
    if masks_made:
        warnings.append("the picture has no mask: the person was cut out by the outline of the body; look at mask.png")
    person = person_in(found.photographs, found.posture, [*warnings, *quality.warnings()])
    return dataclasses.replace(person, fit=quality.content(), masks_made=masks_made)


def person_in(photographs: Sequence[Photograph], posture: Posture, warnings: Sequence[str] = ()) -> CapturedPerson:
    """The person in pictures whose posture is known."""
    names, whole_views = [photograph.path.name for photograph in photographs], views_of(photographs, posture.camera)
    views = whole = _views(photographs, posture)
    if len(photographs) == 1:
        views = _above_cut(whole, posture)
    if views is not whole:
        warnings = [*warnings, "the picture shows no feet: what is below its lowest part of the person is guessed"]
    return CapturedPerson(names, None, (), views, posture.betas, tuple(warnings), tuple(whole_views))


def _above_cut(views: Views, posture: Posture) -> Views:
    """The rows of one picture down to the lowest of the mask, if the body goes on below: it is there, but not shown."""
    rows = (views.mask[0] > 127).any(1).nonzero()[:, 0]
    (pose,), (camera,) = each(posture.pose), each(posture.camera)
    lowest = camera.project(pose_body(posture.betas, pose).vertices)[0][:, 1].amax()
    if not len(rows) or lowest - rows[-1] < CUT_OFF * (rows[-1] - rows[0]):
        return views
    height = int(rows[-1]) + 1
    return dataclasses.replace(
        views, rgba=views.rgba[:, :height], camera=dataclasses.replace(views.camera, height=height)
    )


def initial_pose(
    photographs: Sequence[Photograph],
    model: DiffusionModel,
    pose_path: Path | None = None,
    cameras_path: Path | None = None,
) -> InitialPose:
    """The posture to start from: of the files given, else of a standing body, seen as large as in the pictures.

    Raises FileNotFoundError, and ValueError for files that are not poses or cameras, or not one for each picture.
    """
    sizes = [(photograph.width, photograph.height) for photograph in photographs]
    known = None if pose_path is None else read_posture(pose_path, sizes)
    views = known and known.views if cameras_path is None else read_cameras(cameras_path, sizes)
    tilted = views is None or len(views) == 1  # cameras of several pictures belong together
    stated = [views is not None or photograph.focal is not None for photograph in photographs]
    if known is None:
        found = [
            _standing(photograph, model, None if views is None else views[i], turned=len(photographs) > 1)
            for i, photograph in enumerate(photographs)
        ]
        pictures = [i for i, postures in enumerate(found) for _ in postures]
        posture = _together([one for postures in found for one in postures])
        return InitialPose(posture, pictures, 1.0, complete=False, tilted=tilted, stated=[stated[i] for i in pictures])
    pose = repeated(known.pose, len(photographs))
    betas = model.shapes.bias.clone() if known.betas is None else known.betas
    if views is None:
        pose = turned_to_camera(pose)
        camera = framed(photographs, pose, betas, [photograph.lens() for photograph in photographs])
    else:
        camera = cameras_of(photographs, views)
    posture, pictures = Posture(pose, betas, camera), range(len(photographs))
    complete = views is not None
    return InitialPose(posture, pictures, POSE_FILE_PRECISION, complete=complete, tilted=tilted, stated=stated)


def _standing(photograph: Photograph, model: DiffusionModel, view: View | None, turned: bool) -> list[Posture]:
    """Standing bodies of the turns that fit the outline nearly as well as the best, each in its best stance.

    Not `turned`: a single picture shows a person from the front, in one of several stances; outlines tell front from
    back too seldom.
    """
    payload, betas, found = _mean_human(model), model.shapes.bias.clone(), []
    for degrees, stances in STANCES if turned else STANCES[:1]:
        tried = []
        for stance in stances:
            pose = standing(*stance, turned=degrees)
            lens = photograph.lens() if view is None else view
            posture = Posture(pose, betas, framed([photograph], pose, betas, [lens]))
            tried.append((outline_error(payload, _targets([photograph], posture, OUTLINE_SIDE)[0]), posture))
        found += sorted(tried, key=lambda one: one[0])[: 1 if turned else STANCES_TRIED]
    likely = [found[one][1] for one in _likely([error for error, _ in found], [0] * len(found), LIKELY_START)]
    return likely if view is None else [place_in_camera(one, cameras_of([photograph], [view])) for one in likely]


def _together(postures: Sequence[Posture]) -> Posture:
    """Postures of one shape in one batch."""
    pose = BodyPose(*(torch.cat(values) for values in zip(*(vars(one.pose).values() for one in postures), strict=True)))
    return Posture(pose, postures[0].betas, stack([camera for one in postures for camera in each(one.camera)]))


def fit_posture_in(
    model: DiffusionModel, photographs: Sequence[Photograph], start: InitialPose, on_step: Callable[[], None]
) -> Found:
    """The posture in the pictures; deterministic. Things that no body explains are left out of the last stage.

    `on_step` is called POSTURE_STEPS times. Raises ValueError as `PriorFit.of`.
    """
    components, pictures = PriorFit.of(model), list(start.pictures)
    fit = PostureFit(start.posture, model.shapes, start.prior_precision, tilted=start.tilted, stated=start.stated)
    people = components.everyone()

    def targets(side: int) -> list[PosedView]:
        return _targets([photographs[picture] for picture in pictures], fit.posture(), side)

    for number, (side, refinement, coefficient_steps) in enumerate(FIT_STAGES):
        payload = components.payload(components.coefficients(people))
        if number in (0, len(FIT_STAGES) - 1) and len(pictures) == len(photographs):
            photographs = _cut_out(payload, photographs, targets(side))
        if number == len(FIT_STAGES) - 1:
            pairs = zip(photographs, targets(side), strict=True)
            photographs = [
                one if one.uncut is not None else without_things(payload, one, target) for one, target in pairs
            ]
        several = len(pictures) > len(photographs)
        fit.refine(payload, targets(side), refinement, on_step, shaped=not several)  # a wrong turn would bend the shape
        if several:
            if coefficient_steps:
                kept = _turns(components, fit, [photographs[one] for one in pictures], pictures, side)
            else:
                share, blur = (LIKELY, 0.0) if len(photographs) > 1 else (1.0, STANCE_BLUR)
                kept = _likely([outline_error(payload, one, blur) for one in targets(side)], pictures, share)
            fit.keep(kept)
            pictures = [pictures[one] for one in kept]
        for _ in range(coefficient_steps):
            people = components.gauss_newton_step(people, targets(side))
            on_step()
    return Found(fit.posture(), photographs)


def _likely(errors: Sequence[float], pictures: Sequence[int], share: float = 1.0) -> list[int]:
    """Numbers of the errors that are the least of their picture, or less than `share` times as large."""
    least: dict[int, int] = {}
    for number, picture in enumerate(pictures):
        least[picture] = min(least.get(picture, number), number, key=errors.__getitem__)
    pairs = enumerate(pictures)
    return [one for one, own in pairs if one == least[own] or errors[one] < share * errors[least[own]]]


def _turns(
    components: PriorFit, fit: PostureFit, photographs: Sequence[Photograph], pictures: Sequence[int], side: int
) -> list[int]:
    """Numbers of the turns, one for each picture, with which one person explains the first picture and each other best.

    In a wrong turn that person has hair for a face in one of the two; turned wrongly in both, hair with a mouth.
    """
    targets, found = _targets(photographs, fit.posture(), side), []
    fit.refine([_person_in(components, [one]) for one in targets], targets, OWN_COLOURS, shaped=False)
    targets = _targets(photographs, fit.posture(), side)
    for first in range(pictures.count(0)):
        errors = [0.0 if number == first else math.inf for number in range(pictures.count(0))]
        for other in targets[len(errors) :]:
            person = _person_in(components, [targets[first], other])
            errors.append(colour_error(person, targets[first]) + colour_error(person, other))
        kept = _likely(errors, pictures)
        found.append((sum(errors[one] for one in kept), kept))
    return min(found)[1]


def _person_in(components: PriorFit, targets: Sequence[PosedView]) -> Payload:
    """The person of any colours that explains pictures best."""
    people = components.everyone()
    for _ in range(TURN_STEPS):
        people = components.gauss_newton_step(people, targets)
    return components.payload(components.coefficients(people))


def fit_quality(model: DiffusionModel, photographs: Sequence[Photograph], found: Found) -> FitQuality:
    """Rate the result of a fit by its pictures. Raises ValueError as `PriorFit.of`."""
    pairs = zip(found.photographs, photographs, strict=True)
    left_out = max(1 - _area(kept) / _area(one) if kept.uncut is None else 0.0 for kept, one in pairs)
    targets = _targets(found.photographs, found.posture, FIT_STAGES[0].side)
    return quality_of(PriorFit.of(model), found.posture, targets, left_out)


def _cut_out(payload: Payload, photographs: Sequence[Photograph], targets: Sequence[PosedView]) -> list[Photograph]:
    """The photographs; the persons of those without a mask are cut out again, by the human's outline."""
    pairs = zip(photographs, targets, strict=True)
    return [one if one.uncut is None else cut_by_outline(payload, one, target) for one, target in pairs]


def _cut_out_twice(model: DiffusionModel, photographs: Sequence[Photograph], posture: Posture) -> Sequence[Photograph]:
    """Cut out (`_cut_out`) by the mean human, then by one with the colours and clothes of the first cut."""
    if all(one.uncut is None for one in photographs):
        return photographs
    components = PriorFit.of(model)
    people = components.everyone()
    for stage in FIT_STAGES[:2]:
        for _ in range(stage.coefficient_steps):
            people = components.gauss_newton_step(people, _targets(photographs, posture, stage.side))
        payload = components.payload(components.coefficients(people))
        photographs = _cut_out(payload, photographs, _targets(photographs, posture, FIT_STAGES[-1].side))
    return photographs


def _mean_human(model: DiffusionModel) -> Payload:
    components = PriorFit.of(model)
    return components.payload(components.coefficients(components.everyone()))


def _body_in(
    model: DiffusionModel, pose_path: Path, cameras_path: Path | None, size: tuple[int, int]
) -> UInt8[np.ndarray, "H W"]:
    """255 near the body of a posture in a picture of this width and height that has no mask."""
    load_opencv()
    known = read_posture(pose_path, [size])
    views = known.views if cameras_path is None else read_cameras(cameras_path, [size])
    if views is None:
        raise ValueError(
            "the picture has neither alpha nor a mask, and the pose no camera, so the person cannot be cut out: give "
            "one of them"
        )
    camera, scale = as_camera(views[0]), min(1.0, OUTLINE_IN_PICTURE / max(size))
    small = dataclasses.replace(camera, width=round(scale * size[0]), height=round(scale * size[1]))
    betas = model.shapes.bias if known.betas is None else known.betas
    posture = Posture(repeated(known.pose, 1), betas, stack([resized(camera, scale, small)]))
    return outline_in(_mean_human(model), posture, size)


def _area(photograph: Photograph) -> float:
    """Area of the person, pixels; at least 1."""
    return max(1.0, photograph.rgba[..., 3].sum(dtype=np.float64) / 255)


def _views(photographs: Sequence[Photograph], posture: Posture) -> Views:
    rgba = np.stack([photograph.rgba for photograph in photographs])
    return Views(torch.from_numpy(rgba), posture.camera, posture.pose)


def _targets(photographs: Sequence[Photograph], posture: Posture, side: int) -> list[PosedView]:
    return targets_of(_views(photographs, posture), posture.frames(), side)
