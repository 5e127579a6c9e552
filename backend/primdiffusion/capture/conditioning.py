"""Which pictures of a captured person the encoder is given: views of one frame, spread around the person."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import default_body
from primdiffusion.capture.dataset import Views, stack
from primdiffusion.capture.people_files import LARGEST_BETA
from primdiffusion.capture.reader import (
    CAMERAS_FILE,
    Captures,
    Subject,
    as_camera,
    open_captures,
    resample,
    through,
    whole,
)
from primdiffusion.capture.sheet import default_joints, joints_of
from primdiffusion.formats import capture_layout
from primdiffusion.formats.camera_rig import View

LARGEST_SIDE = 512
"""Pixels a side of what the encoder is trained on; larger pictures are averaged down to it."""
SAME_BODY_M = 0.02
"""How far joints may lie from the default body's; another body's are centimetres away."""
LEAST_COVERED = 0.8
"""Share of the body inside the masks; dressed people of the default body have more than 0.95."""
_EACH = 20
"""Of the body's vertices only every so many-th is projected."""
_NAMED = 3


class ConditioningError(ValueError):
    """Captures that the encoder cannot be given; one sentence that says what to do."""


@dataclasses.dataclass(frozen=True, eq=False)
class CapturedPerson:
    """A person as the encoder is given them."""

    subject: str
    frame: int
    cameras: tuple[int, ...]
    """Numbers of the views in cameras.json."""
    views: Views
    """Unbatched, [v]."""
    betas: Float[Tensor, "10"]
    """Of the default body."""
    warnings: tuple[str, ...]
    """Sentences for the user: what makes the result doubtful."""


def captured_person(path: str | Path, subject: str | None = None, frame: int = 0, views: int = 8) -> CapturedPerson:
    """Somebody of a dataset, or of one subject's own folder, in one frame; `views` spread cameras, or all there are.

    Raises:
        FileNotFoundError: there is no such folder, or a file of the person's is missing.
        ConditioningError: nobody, or several people, can be meant; no such frame; another body model.
        CaptureFolderError, CaptureFileError, ArrayFileError, BodyFileError: a file is damaged or of another size.
    """
    captures, name = choose_subject(path, subject)
    person = captures.subject(name)
    betas = default_betas(person)
    _check_frame(person, frame)
    cameras = spread_cameras(person, frame, views)
    given = conditioning_views(captures, name, frame, cameras)
    warnings = [] if len(cameras) > 1 else ["one view only: sides that it does not see are guessed"]
    covered = _covered_share(person, frame, cameras, given)
    if covered < LEAST_COVERED:
        warnings.append(
            f"only {100 * covered:.0f} % of the body of {name} lies inside the masks: the betas or poses may be of "
            "another body model, or the cameras of another scene"
        )
    return CapturedPerson(name, frame, cameras, given, betas, tuple(warnings))


def choose_subject(path: str | Path, subject: str | None = None) -> tuple[Captures, str]:
    """The captures of a folder, which may be one subject's own, and whom of them `subject` means.

    Raises:
        FileNotFoundError: there is no such folder, or nobody in it.
        ConditioningError: there is no such subject, or several and none is named.
        CaptureFolderError, CaptureFileError: the dataset's own files are damaged.
    """
    path = Path(path).absolute()
    if (path / CAMERAS_FILE).is_file():
        about = capture_layout.read_about(path.parent) if (path.parent / capture_layout.DATASET_FILE).is_file() else {}
        captures = Captures(path.parent, (path.name,), about)
    else:
        captures = open_captures(path)
    names = captures.subjects
    if subject is None and len(names) == 1:
        return captures, names[0]
    if subject in names:
        return captures, subject
    shown = [*difflib.get_close_matches(subject or "", names, _NAMED, 0.8), *names][:_NAMED]
    others = f" and {len(names) - len(shown)} more" if len(names) > len(shown) else ""
    there = f"{', '.join(shown)}{others}"
    if subject is None:
        raise ConditioningError(f"{path} holds several subjects: name one of them ({there})")
    raise ConditioningError(f"there is no subject {subject!r} in {path}: choose of {there}")


def conditioning_views(
    captures: Captures,
    subject: str,
    frame: int = 0,
    cameras: Sequence[int] | None = None,
    largest_side: int = LARGEST_SIDE,
) -> Views:
    """Views [v] of a person in a frame, squares over black; None: of all cameras.

    Their side is that of the largest picture, but `largest_side` at most; cameras see through the squares.

    Raises:
        KeyError: there is nobody of this name.
        FileNotFoundError: a picture, or another file of the person's, is missing.
        ConditioningError: there is no such frame or camera, or none of them shows the person.
        CaptureFileError, ArrayFileError, BodyFileError: a file is damaged, or a mask of another size than its picture.
    """
    person = captures.subject(subject)
    _check_frame(person, frame)
    numbers = range(len(person.views)) if cameras is None else cameras
    if not numbers or not all(0 <= number < len(person.views) for number in numbers):
        last = len(person.views) - 1
        raise ConditioningError(f"{subject} has cameras 0 to {last}, not {list(numbers)}: choose at least one of them")
    side = min(largest_side, max(max(person.views[n].width, person.views[n].height) for n in numbers))
    pictures, seen = [], []
    for number in numbers:
        view = person.views[number]
        image, mask = (person.picture(kind, frame, number) for kind in ("img", "mask"))
        rgba = np.concatenate([image, mask[..., None]], axis=-1)
        pictures.append(resample(rgba, whole(view), side))
        seen.append(as_camera(through(view, whole(view), side)))
    views = Views(torch.from_numpy(np.stack(pictures)), stack(seen), person.smpl.pose(frame))
    if not views.mask.any():
        raise ConditioningError(f"no mask of {subject} in frame {frame} shows a person: choose another frame or views")
    return views


def spread_cameras(subject: Subject, frame: int, count: int) -> tuple[int, ...]:
    """Numbers of `count` cameras around a person, in order; all where there are no more.

    The first is the one that sees most of the face; each next is the farthest, as an angle, from those chosen.
    Raises ConditioningError for less than one camera.
    """
    if count < 1:
        raise ConditioningError(f"{count} views were asked for: the encoder needs one or more")
    if count >= len(subject.views):
        return tuple(range(len(subject.views)))
    pose = subject.smpl.pose(frame)
    pelvis = joints_of(subject)[frame, 0]
    offset = np.stack([view.position for view in subject.views]) - pelvis
    direction = offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-9)
    forward = pose.joint_rotation[0, :, 2].double().numpy()
    chosen = [int(np.argmax((direction @ forward).round(6)))]
    while len(chosen) < count:
        nearness = (direction @ direction[chosen].T).max(axis=1).round(6)
        nearness[chosen] = np.inf
        chosen.append(int(np.argmin(nearness)))
    return tuple(sorted(chosen))


def default_betas(subject: Subject) -> Float[Tensor, "10"]:
    """A person's betas as those of the default body; fewer than ten are filled up with zeros.

    Raises:
        ConditioningError: there are more, impossible ones, or joints were noted that are not the default body's.
        ArrayFileError: joints.npz is damaged.
    """
    betas, components = torch.from_numpy(subject.smpl.betas), default_body().shape_basis.shape[-1]
    remedy = "render the person again on the default body (primdiffusion captures, or Blender's without a body file)"
    if len(betas) > components or not (betas.abs() <= LARGEST_BETA).all():
        raise ConditioningError(
            f"{subject.folder} has {len(betas)} betas, up to {float(betas.abs().max()):.3g} from 0: needed are at most "
            f"{components} of the default body, within {LARGEST_BETA:g}; {remedy}"
        )
    apart = float(np.linalg.norm(joints_of(subject) - default_joints(subject), axis=-1).max())
    if not apart <= SAME_BODY_M:
        raise ConditioningError(
            f"the joints of {subject.folder} lie up to {100 * apart:.0f} cm from the default body's: its betas are of "
            f"another body model; {remedy}"
        )
    return torch.nn.functional.pad(betas, (0, components - len(betas)))


def _check_frame(subject: Subject, frame: int) -> None:
    if not 0 <= frame < subject.frames:
        raise ConditioningError(f"{subject.name} has frames 0 to {subject.frames - 1}, not {frame}: choose one of them")


def _covered_share(subject: Subject, frame: int, cameras: Sequence[int], views: Views) -> float:
    """Of the body's points that fall into the pictures, how many lie inside the masks.

    Raises ConditioningError where none does.
    """
    body = default_body().shape(torch.from_numpy(subject.smpl.betas)).pose(subject.smpl.pose(frame))
    points, size = body.vertices[::_EACH].double().numpy(), views.rgba.shape[-2]
    inside = [
        mask[pixels[:, 1], pixels[:, 0]] > 0
        for camera, mask in zip(cameras, views.mask.numpy(), strict=True)
        for pixels in [_pixels(through(subject.views[camera], whole(subject.views[camera]), size), points)]
    ]
    covered = np.concatenate(inside)
    if not covered.any():
        raise ConditioningError(
            f"no part of the body of {subject.name} is where its masks show a person: its poses, betas and "
            "cameras.json do not belong together; take them from one source"
        )
    return float(covered.mean())


def _pixels(view: View, points: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """Columns and rows [m, 2] of the points that a view has in its picture."""
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel, depth = view.project(points)
    there = (depth > 0) & (pixel >= 0).all(-1) & (pixel < [view.width, view.height]).all(-1)
    return pixel[there].astype(np.int64)
