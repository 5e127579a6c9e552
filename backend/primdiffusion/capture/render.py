"""Render captures of humans in several processes; skip complete subjects and views.

Textured meshes are drawn by the rasteriser; whatever is a `Renderable` can be captured.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import torch
from jaxtyping import Float
from PIL.Image import fromarray

from primdiffusion.body.model import BodyModel, BodyPose
from primdiffusion.capture.people_files import read_person
from primdiffusion.capture.poses import turned
from primdiffusion.files import picture_files
from primdiffusion.files.regular_files import check_unlinked
from primdiffusion.files.whole_files import atomic_replace, write_atomically
from primdiffusion.formats import capture_layout
from primdiffusion.formats.camera_rig import Rig, View, bounding_sphere, extent, first_frames, stand_together
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.formats.requests import FLOAT_DEPTH, PASSES
from primdiffusion.geometry.image import Image
from primdiffusion.geometry.rotation import matrix_to_axis_angle
from primdiffusion.raster.rasterise import Draw
from primdiffusion.raster.textures import BYTE_OF_LINEAR, encode_bytes
from primdiffusion.runtime.device import fixed_threads
from primdiffusion.runtime.failures import to_user_error
from primdiffusion.runtime.worker_process import each

JPEG_QUALITY = 95


class Renderable(Protocol):
    """A human who can be posed and drawn; `skinning` [J, 4, 4] maps the rest pose to the world.

    What drawing needs is prepared on first use: `points` and `posed` raise ValueError if the human cannot be drawn.
    """

    @property
    def betas(self) -> Float[np.ndarray, "n"]:
        """Shape coefficients of `body`."""
        ...

    @property
    def body(self) -> BodyModel:
        """The body that is posed."""
        ...

    def points(self, skinning: Float[np.ndarray, "J 4 4"]) -> Float[np.ndarray, "n 3"]:
        """Points in the world around which everything visible is."""
        ...

    def posed(self, skinning: Float[np.ndarray, "J 4 4"]) -> Draw:
        """Pose the human."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class CaptureSetup:
    """A subject, its poses and its cameras."""

    person: Renderable
    poses: BodyPose
    """[F]."""
    skinning: Float[np.ndarray, "F J 4 4"]
    """World from rest."""
    joints: Float[np.ndarray, "F J 3"]
    """World, metres."""
    views: list[View]


def set_up_capture(person: Renderable, poses: BodyPose, rig: Rig | Sequence[View]) -> CaptureSetup:
    """Pose the subject in all `poses` [F] and place the cameras: a rig that shows every pose whole, or given views.

    Raises:
        ValueError: the human cannot be drawn; the poses are not finite.
    """
    with fixed_threads(1):  # files do not depend on the number of workers
        shaped = person.body.to(dtype=torch.float64).shape(torch.from_numpy(person.betas).double())
        body = shaped.pose(poses.to(dtype=torch.float64))
    skinning, joints = body.skinning.numpy(), body.joints[..., :3, 3].numpy()
    if isinstance(rig, Rig):
        moved = [person.points(matrices) for matrices in skinning]
        views = rig.views(*bounding_sphere(np.concatenate(moved)))
    else:
        views = list(rig)
    return CaptureSetup(person, poses, skinning, joints, views)


def set_up_together(
    people: Sequence[Renderable], own: int, poses: BodyPose, rig: Rig, rng: np.random.Generator
) -> CaptureSetup:
    """The setup of one of several humans who stand together, at other places in every pose, in front of one rig.

    Each takes the poses from another one on, turned at random, with the lowest point on the floor y = 0. Circles on the
    floor around them do not touch.

    Args:
        people: all humans of the group.
        own: index of the human to set up.
        poses: poses [F]; their translation is replaced.
        rig: the cameras around the group in all poses.
        rng: the same for all humans of the group.

    Raises:
        ValueError: a human cannot be drawn; the poses are not finite.
    """
    frames = len(poses.joint_rotation)
    yaws = rng.uniform(-math.pi, math.pi, (len(people), frames))
    own_poses, pelvis, extents = [], [], []
    for person, first, yaw in zip(people, first_frames(len(people), frames), yaws, strict=True):
        rolled = poses.joint_rotation.roll(-first, dims=0)
        own_poses.append(turned(BodyPose(rolled, torch.zeros_like(poses.translation)), yaw))
        setup = set_up_capture(person, own_poses[-1], [])
        pelvis.append(setup.joints[:, 0])
        extents.append([extent(person.points(s), joint) for s, joint in zip(setup.skinning, pelvis[-1], strict=True)])
    moves, corners = stand_together(np.array(pelvis), np.array(extents), rng)
    moved = BodyPose(own_poses[own].joint_rotation, torch.from_numpy(moves[own]).to(poses.translation))
    return set_up_capture(people[own], moved, rig.views(*bounding_sphere(corners)))


def write_parameters(subject: Path, setup: CaptureSetup) -> None:
    """Write SMPL parameters, joints and cameras.

    Raises:
        FileError: the folder contains other poses or another shape.
        OSError: a file cannot be written.
    """
    theta = matrix_to_axis_angle(setup.poses.joint_rotation).numpy().reshape(len(setup.skinning), -1)
    capture_layout.write_smpl(subject, theta[:, :3], theta[:, 3:], setup.person.betas, setup.poses.translation.numpy())
    capture_layout.write_joints(subject, setup.views, setup.joints)
    capture_layout.write_cameras(subject, setup.views)


def render_frames(
    subject: Path, setup: CaptureSetup, frames: Iterable[int], passes: Sequence[str], samples: int
) -> Iterator[tuple[int, int]]:
    """Render the missing views of `frames`; yields frame and camera of every view, also of those found complete.

    Raises:
        OSError: an image cannot be written.
    """
    for frame in frames:
        draw = None
        for camera, view in enumerate(setup.views):
            if not capture_layout.is_complete_view(subject, passes, camera, frame):
                draw = draw or setup.person.posed(setup.skinning[frame])
                write_view(subject, passes, camera, frame, draw(view, samples))
            yield frame, camera


def write_view(subject: Path, passes: Sequence[str], camera: int, frame: int, drawn: Image) -> None:
    """Write the images of one view atomically."""
    for kind in passes:
        path = capture_layout.picture_path(subject, kind, camera, frame)
        if kind == "img":
            with atomic_replace(path) as partial:
                fromarray(srgb_bytes(drawn.rgb)).save(partial, quality=JPEG_QUALITY, subsampling=0)
        elif kind == "mask":
            picture_files.write_png(path, np.round(drawn.alpha.clip(0, 1) * 255).astype(np.uint8))
        elif kind == "depth_float":
            picture_files.write_exr(path, np.where(np.isfinite(drawn.depth), drawn.depth, np.float32(0)))
        elif kind == "depth":
            picture_files.write_png(path, picture_files.depth_steps(drawn.depth))
        elif drawn.normal is None or drawn.part is None:
            raise ValueError(f"{kind} is not drawn of this human: leave it out of the passes")
        elif kind == "normal":
            picture_files.write_png(path, picture_files.normal_bytes(drawn.normal, np.isfinite(drawn.depth)))
        else:
            picture_files.write_png(path, drawn.part)


def srgb_bytes(linear: np.ndarray) -> np.ndarray:
    """Encode linear colours as sRGB bytes."""
    encoded = np.empty(linear.shape, np.uint8)
    encode_bytes(np.ascontiguousarray(linear, np.float32).ravel(), BYTE_OF_LINEAR, encoded.ravel())
    return encoded


@dataclasses.dataclass(frozen=True, eq=False)
class RenderJob:
    """Subjects, poses, cameras and passes of a dataset."""

    people: Mapping[str, Path]
    """Files of humans by subject name."""
    poses: BodyPose
    """[F]; frame 0 is close to the T pose."""
    out: Path
    rig: Rig = dataclasses.field(default_factory=Rig)
    passes: tuple[str, ...] = PASSES
    samples: int = 3
    """Samples along each side of a pixel."""
    seed: int = 0
    released_reference: bool = False
    """Whether the dataset includes the subject whose name the released code looks up for rest sizes."""
    together: tuple[Mapping[str, Path], ...] = ()
    """Groups of humans who stand together, files by name; every subject is in one of them, or there are none."""
    read: Callable[[Path], Renderable] = read_person
    """Reads a human's file; a function of a module, as other processes call it too."""
    renderer: str = "rasteriser"
    """Name in dataset.json of what draws the humans."""
    part: str = "report"
    """Name of the report; runs that share a folder need different ones."""

    @property
    def about(self) -> dict[str, Any]:
        """The dataset's settings, equal for everything rendered into one folder."""
        return {
            "seed": self.seed,
            "rig": dataclasses.asdict(self.rig),
            "frames": len(self.poses.translation),
            "passes": list(self.passes),
            "light": "uniform",
            "background": "black",
            "renderer": self.renderer,
            "samples": self.samples**2,
            "world": "metres, y up, facing +z",
            "depth": {"kind": "z", "unit_m": picture_files.DEPTH_UNIT},
            "part_names": list(JOINT_NAMES),
            "released_reference": self.released_reference,
            **({"together": max(map(len, self.together))} if self.together else {}),
        }


@dataclasses.dataclass(frozen=True)
class SubjectResult:
    """The result of rendering one subject."""

    subject: str
    status: Literal["done", "skipped", "failed"]
    """Subjects that are already complete are skipped."""
    error: str = ""
    views: int = 0


def render(job: RenderJob, workers: int = 1) -> Iterator[SubjectResult]:
    """Render all subjects; yields the result of each. A failed subject does not stop the others.

    A subject is skipped if it has a complete.json, and a view if all its images exist.

    Raises:
        FileError: the folder contains something else.
        ValueError: a pass is unknown, workers is less than 1, or a worker was killed.
        OSError: the folder cannot be written.
    """
    possible = (*PASSES, FLOAT_DEPTH)
    if unknown := set(job.passes) - set(possible) or not job.passes:
        raise ValueError(f"passes {unknown or '()'} cannot be rendered: choose from {', '.join(possible)}")
    if workers < 1:
        raise ValueError(f"workers is {workers}: give 1 or more")
    capture_layout.claim(job.out, job.about)
    outcomes, waiting = [], []
    for name in job.people:
        if capture_layout.is_complete(job.out / name):
            outcomes.append(SubjectResult(name, "skipped"))
            yield outcomes[-1]
        else:
            waiting.append((job, name))
    for outcome in each(_render_subject, waiting, workers):
        outcomes.append(outcome)
        _write_report(job, outcomes)
        yield outcome
    _write_report(job, outcomes)


def _render_subject(job: RenderJob, name: str) -> SubjectResult:
    """Render what is missing of a subject; errors of input and files become a failed result."""
    try:
        setup = _set_up(job, name)
        check_unlinked(job.out / name)
        write_parameters(job.out / name, setup)
        frames = range(len(setup.skinning))
        views = sum(1 for _ in render_frames(job.out / name, setup, frames, job.passes, job.samples))
        capture_layout.complete(job.out / name)
        return SubjectResult(name, "done", views=views)
    except Exception as e:
        failure = to_user_error(e)
        if failure is None:
            raise
        return SubjectResult(name, "failed", str(failure))


def _set_up(job: RenderJob, name: str) -> CaptureSetup:
    group = next((group for group in job.together if name in group), None)
    if group is None:
        return set_up_capture(job.read(job.people[name]), job.poses, job.rig)
    names = sorted(group)
    rng = np.random.default_rng(capture_layout.view_seed(job.seed, names[0], 0, 0))
    return set_up_together([job.read(group[n]) for n in names], names.index(name), job.poses, job.rig, rng)


def _write_report(job: RenderJob, outcomes: Sequence[SubjectResult]) -> None:
    """Write the list of finished subjects and the report."""
    capture_layout.list_subjects(job.out)
    report = {
        "done": [outcome.subject for outcome in outcomes if outcome.status == "done"],
        "failed": [
            {"subject": outcome.subject, "what": "render", "why": outcome.error}
            for outcome in outcomes
            if outcome.status == "failed"
        ],
        "skipped": [outcome.subject for outcome in outcomes if outcome.status == "skipped"],
    }
    write_atomically(job.out / f"{job.part}.json", json.dumps(report, indent=1))
