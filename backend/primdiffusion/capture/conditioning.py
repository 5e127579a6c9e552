"""Choose the images of a captured subject that the encoder gets: views of one frame, spread around the subject."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from primdiffusion.body.model import BodyModel, default_body
from primdiffusion.capture.dataset import stack
from primdiffusion.capture.people_files import LARGEST_CAPTURED_BETA
from primdiffusion.capture.reader import (
    CAMERAS_FILE,
    Captures,
    Subject,
    Views,
    as_camera,
    full_window,
    joints_from_body,
    joints_of,
    open_captures,
    resample,
    windowed_view,
)
from primdiffusion.formats import capture_layout
from primdiffusion.formats.camera_rig import View

LARGEST_SIDE = 512
"""Width and height of the encoder's training images, pixels; larger ones are downsampled."""
SAME_BODY_M = 0.02
"""Largest distance of joints from the default body's; those of other bodies are centimetres away."""
LEAST_COVERED = 0.8
"""Fraction of the body inside the masks; dressed humans on the default body have more than 0.95."""
_EACH = 20
"""Step between the vertices of the body that are projected."""
_NAMED = 3


@dataclasses.dataclass(frozen=True, eq=False)
class CapturedPerson:
    """A subject to reconstruct."""

    subject: str | list[str]
    """Name of the subject, or those of plain pictures."""
    frame: int | None
    """None for plain pictures."""
    cameras: tuple[int, ...]
    """Indices of the views in cameras.json."""
    views: Views
    """Unbatched, [v]; in plain pictures the pose is [v] too."""
    betas: Float[Tensor, "10"]
    """Betas of the encoder's body."""
    warnings: tuple[str, ...]
    """Messages for the user about problems of the captures or pictures."""
    whole_views: tuple[View, ...] = ()
    """Cameras of plain pictures, as found; those of `views` see squares cut out of them."""
    fit: Mapping[str, Any] | None = None
    """Quality of the posture in plain pictures, as posture.json holds it: `FitQuality.content`."""
    masks_made: tuple[UInt8[np.ndarray, "H W"], ...] = ()
    """Masks of whole pictures that had none, of upright pixels."""


def captured_person(
    path: str | Path, subject: str | None = None, frame: int = 0, views: int = 8, body: BodyModel | None = None
) -> CapturedPerson:
    """A subject of a dataset, or of its own folder, in one frame; `views` spread cameras, or all if there are fewer.

    `body` is the encoder's; None is the default body.

    Raises:
        FileNotFoundError: the folder or a file of the subject does not exist.
        ValueError: the subject is missing or ambiguous, the frame is missing, or another body model was used.
        FileError: a file is damaged or has another size.
    """
    captures, name = choose_subject(path, subject)
    person = captures.subject(name)
    body = default_body() if body is None else body
    betas = body_betas(person, body)
    _check_frame(person, frame)
    cameras = spread_cameras(person, frame, views, body)
    chosen = conditioning_views(captures, name, frame, cameras)
    warnings = [] if len(cameras) > 1 else ["only one view: the sides that it does not show are guessed"]
    covered = _covered_share(person, frame, cameras, chosen, body)
    if covered < LEAST_COVERED:
        warnings.append(
            f"only {100 * covered:.0f} % of the body of {name} is inside the masks: the betas or poses may belong to "
            "another body model, or the cameras to another scene"
        )
    return CapturedPerson(name, frame, cameras, chosen, betas, tuple(warnings))


def choose_subject(path: str | Path, subject: str | None = None) -> tuple[Captures, str]:
    """Open a dataset, or a subject's own folder, and return it with the name of the subject.

    Raises:
        FileNotFoundError: the folder does not exist or contains no subjects.
        ValueError: there is no such subject, or several and `subject` is None.
        FileError: the dataset's own files are damaged.
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
    available = f"{', '.join(shown)}{others}"
    if subject is None:
        raise ValueError(f"{path} contains several subjects: name one of them ({available})")
    raise ValueError(f"there is no subject {subject!r} in {path}: choose from {available}")


def conditioning_views(
    captures: Captures,
    subject: str,
    frame: int = 0,
    cameras: Sequence[int] | None = None,
    largest_side: int = LARGEST_SIDE,
) -> Views:
    """Square views [v] of a subject in a frame, over black; None for all cameras.

    Their size is that of the largest image, at most `largest_side`; the cameras are adjusted to it.

    Raises:
        KeyError: there is no subject of this name.
        FileNotFoundError: a file of the subject is missing.
        ValueError: there is no such frame or camera, or no mask shows the subject.
        FileError: a file is damaged, or a mask and its image differ in size.
    """
    person = captures.subject(subject)
    _check_frame(person, frame)
    numbers = range(len(person.views)) if cameras is None else cameras
    if not numbers or not all(0 <= number < len(person.views) for number in numbers):
        last = len(person.views) - 1
        raise ValueError(f"{subject} has cameras 0 to {last}, not {list(numbers)}: choose at least one of them")
    side = min(largest_side, max(max(person.views[n].width, person.views[n].height) for n in numbers))
    pictures, seen = [], []
    for number in numbers:
        view = person.views[number]
        pictures.append(resample(person.rgba(frame, number), full_window(view), side))
        seen.append(as_camera(windowed_view(view, full_window(view), side)))
    views = Views(torch.from_numpy(np.stack(pictures)), stack(seen), person.smpl.pose(frame))
    if not views.mask.any():
        raise ValueError(f"no mask of {subject} in frame {frame} shows a human: choose another frame or views")
    return views


def spread_cameras(subject: Subject, frame: int, count: int, body: BodyModel | None = None) -> tuple[int, ...]:
    """Indices of `count` cameras around a subject, sorted; all if there are fewer.

    The first faces the subject most directly; each next is the farthest in angle from those chosen.
    Raises ValueError if `count` is less than 1.
    """
    if count < 1:
        raise ValueError(f"{count} views were requested: the encoder needs 1 or more")
    if count >= len(subject.views):
        return tuple(range(len(subject.views)))
    pose = subject.smpl.pose(frame)
    pelvis = joints_of(subject, body)[frame, 0]
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
    """Betas of the subject on the default body, padded with zeros to ten. Raises as `body_betas`."""
    return body_betas(subject, default_body())


def body_betas(subject: Subject, body: BodyModel) -> Float[Tensor, "n"]:
    """Betas of the subject on a body, padded with zeros to the number of its shape components.

    Raises:
        ValueError: there are too many, they are out of range, or stored joints are not the body's.
        FileError: joints.npz is damaged.
    """
    betas, components = torch.from_numpy(subject.smpl.betas), body.shape_basis.shape[-1]
    name, remedy = (
        "default body",
        ("render the human again on the default body (primdiffusion captures, or Blender's without a body file)"),
    )
    if body is not default_body():
        name, remedy = "encoder's body", "use captures that are fitted to the SMPL file that the encoder refers to"
    if len(betas) > components or not (betas.abs() <= LARGEST_CAPTURED_BETA).all():
        raise ValueError(
            f"{subject.folder} has {len(betas)} betas of up to {float(betas.abs().max()):.3g}; there may be at most "
            f"{components} of the {name}, within {LARGEST_CAPTURED_BETA:g}: {remedy}"
        )
    distance = float(np.linalg.norm(joints_from_body(subject, body), axis=-1).max())
    if not distance <= SAME_BODY_M:
        raise ValueError(
            f"the body's joints in {subject.folder} are up to {100 * distance:.0f} cm from the {name}'s, so its betas "
            f"belong to another body model; {remedy}"
        )
    return torch.nn.functional.pad(betas, (0, components - len(betas)))


def _check_frame(subject: Subject, frame: int) -> None:
    if not 0 <= frame < subject.frames:
        raise ValueError(f"{subject.name} has frames 0 to {subject.frames - 1}, not {frame}: choose one of them")


def _covered_share(subject: Subject, frame: int, cameras: Sequence[int], views: Views, body: BodyModel) -> float:
    """Fraction of the body's projected points that are inside the masks.

    Raises ValueError if it is 0.
    """
    posed = body.shape(torch.from_numpy(subject.smpl.betas)).pose(subject.smpl.pose(frame))
    points, size = posed.vertices[::_EACH].double().numpy(), views.rgba.shape[-2]
    inside = [
        mask[pixels[:, 1], pixels[:, 0]] > 0
        for camera, mask in zip(cameras, views.mask.numpy(), strict=True)
        for pixels in [_pixels(windowed_view(subject.views[camera], full_window(subject.views[camera]), size), points)]
    ]
    covered = np.concatenate(inside)
    if not covered.any():
        raise ValueError(
            f"the body of {subject.name} projects outside its masks: its poses, betas and cameras.json do not belong "
            "together; take them from one source"
        )
    return float(covered.mean())


def _pixels(view: View, points: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """Columns and rows [m, 2] of the points inside the image."""
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel, depth = view.project(points)
    visible = (depth > 0) & (pixel >= 0).all(-1) & (pixel < [view.width, view.height]).all(-1)
    return pixel[visible].astype(np.int64)
