"""One person's views drawn by the rasteriser and written in the layout of captures."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import json
import math
import multiprocessing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from primdiffusion.body.model import BodyPose, default_body
from primdiffusion.capture.people_files import SkinnedPerson, read_person
from primdiffusion.failures import describe
from primdiffusion.formats import camera_files, capture_layout, picture_files
from primdiffusion.formats.arrays import ArrayFileError, read_numbers
from primdiffusion.formats.camera_rig import Rig, View, bounding_sphere
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.geometry.rotation import matrix_to_axis_angle
from primdiffusion.raster.multisample import Figure, Shot, figure_of, shoot
from primdiffusion.raster.textures import BYTE_OF_LINEAR, encode_bytes
from primdiffusion.worker_process import begin_worker

JPEG_QUALITY = 95


@dataclasses.dataclass(frozen=True, eq=False)
class Sitting:
    """A person, the poses to take and the cameras about them."""

    figure: Figure
    betas: Float[np.ndarray, "n"]
    poses: BodyPose
    """Of F frames."""
    skinning: Float[np.ndarray, "F J 4 4"]
    """World from rest."""
    joints: Float[np.ndarray, "F J 3"]
    """World, metres."""
    views: list[View]


def sit(person: SkinnedPerson, poses: BodyPose, rig: Rig | Sequence[View]) -> Sitting:
    """The person in all `poses` [F], the cameras of a rig as far away as shows all of them whole, or given ones.

    Raises:
        UnusableMesh: the mesh cannot be drawn.
        ValueError: the poses are not finite.
    """
    figure = figure_of(person.mesh)
    with _one_thread():
        shaped = default_body().to(dtype=torch.float64).shape(torch.from_numpy(person.betas).double())
        body = shaped.pose(poses.to(dtype=torch.float64))
    skinning, joints = body.skinning.numpy(), body.joints[..., :3, 3].numpy()
    if isinstance(rig, Rig):
        moved = [part.posed(matrices).vertices for matrices in skinning for part in person.mesh.parts]
        views = rig.views(*bounding_sphere(np.concatenate(moved)))
    else:
        views = list(rig)
    return Sitting(figure, person.betas, poses, skinning, joints, views)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Sums in one order, so that any number of workers writes the same files to the last digit."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def begin(subject: Path, sitting: Sitting) -> None:
    """Write all but the pictures.

    Raises:
        CaptureFolderError: the folder holds pictures of other poses or another shape.
        OSError: it cannot be written to.
    """
    theta = matrix_to_axis_angle(sitting.poses.joint_rotation).numpy().reshape(len(sitting.skinning), -1)
    translation = sitting.poses.translation.numpy()
    _refuse_others(subject, theta, sitting.betas, translation)
    capture_layout.write_smpl(subject, theta[:, :3], theta[:, 3:], sitting.betas, translation)
    capture_layout.write_joints(subject, sitting.views, sitting.joints)
    camera_files.write_cameras(subject, sitting.views)
    camera_files.write_opencv(subject, sitting.views)
    for frame in range(len(theta)):
        camera_files.write_nerf(subject, sitting.views, frame)
        camera_files.write_colmap(subject, sitting.views, frame)


def draw_frames(
    subject: Path, sitting: Sitting, frames: Iterable[int], passes: Sequence[str], samples: int
) -> Iterator[tuple[int, int]]:
    """Draw the views of `frames` that are not there yet; yields frame and camera of each, drawn or found.

    Raises:
        OSError: a picture cannot be written.
    """
    for frame in frames:
        posed = None
        for camera, view in enumerate(sitting.views):
            if not is_drawn(subject, passes, camera, frame):
                posed = sitting.figure.posed(sitting.skinning[frame]) if posed is None else posed
                write_shot(subject, passes, camera, frame, shoot(posed, view, samples))
            yield frame, camera


def last_pass(passes: Sequence[str]) -> str:
    """The pass whose picture is written last: the view is done when it is whole."""
    return "img" if "img" in passes else passes[-1]


def is_drawn(subject: Path, passes: Sequence[str], camera: int, frame: int) -> bool:
    """Whether all pictures of a view are there and whole."""
    return all(
        picture_files.is_whole_picture(capture_layout.picture_path(subject, kind, camera, frame)) for kind in passes
    )


def write_shot(subject: Path, passes: Sequence[str], camera: int, frame: int, shot: Shot) -> None:
    """The pictures of one view, each written whole, the one that marks the view as done last."""
    for kind in sorted(passes, key=lambda kind: kind == last_pass(passes)):
        path = capture_layout.picture_path(subject, kind, camera, frame)
        if kind == "img":
            with capture_layout.replacing(path) as partial:
                Image.fromarray(srgb_bytes(shot.rgb)).save(partial, quality=JPEG_QUALITY, subsampling=0)
        elif kind == "mask":
            picture_files.write_png(path, np.round(shot.coverage.clip(0, 1) * 255).astype(np.uint8))
        elif kind == "depth":
            picture_files.write_png(path, picture_files.depth_steps(shot.depth))
        elif kind == "normal":
            picture_files.write_png(path, picture_files.normal_bytes(shot.normal, shot.depth > 0))
        else:
            picture_files.write_png(path, shot.part)


def srgb_bytes(linear: np.ndarray) -> np.ndarray:
    """Linear colours as sRGB-encoded bytes."""
    encoded = np.empty(linear.shape, np.uint8)
    encode_bytes(np.ascontiguousarray(linear, np.float32).ravel(), BYTE_OF_LINEAR, encoded.ravel())
    return encoded


def _refuse_others(subject: Path, theta: np.ndarray, betas: np.ndarray, translation: np.ndarray) -> None:
    path = subject / capture_layout.SMPL_FOLDER / capture_layout.SMPL_PLAIN_FILE
    wanted = {"global_orient": theta[:, :3], "body_pose": theta[:, 3:], "betas": betas[None], "transl": translation}
    try:
        present = read_numbers(path, tuple(wanted))
    except (FileNotFoundError, ArrayFileError):
        return  # nothing yet, or cut short: it is written anew
    for name, values in wanted.items():
        if present[name].shape != values.shape or not np.allclose(present[name], values, atol=1e-5):
            raise capture_layout.CaptureFolderError(
                f"{subject} holds another person or other poses ({name} differ): choose another folder, or remove it"
            )


PASSES = tuple(kind for kind in capture_layout.ENDINGS if kind in ("img", "mask", "depth", "normal", "part"))


@dataclasses.dataclass(frozen=True, eq=False)
class Job:
    """What to render."""

    people: Mapping[str, Path]
    """.glb files by the names their captures get."""
    poses: BodyPose
    """[F]; frame 0 is the near-T pose."""
    out: Path
    rig: Rig = dataclasses.field(default_factory=Rig)
    passes: tuple[str, ...] = PASSES
    samples: int = 3
    """Of a pixel's side."""
    seed: int = 0
    released_reference: bool = False
    """Whether the dataset has the subject by whose name the released code finds its rest sizes."""
    unread_poses: tuple[str, ...] = ()
    """Why files of poses were left out: for the report."""
    part: str = "report"
    """Name of the report, one for each of several runs that share the folder."""

    @property
    def about(self) -> dict[str, Any]:
        """The dataset's settings, which all that is rendered into the folder must share."""
        return {
            "seed": self.seed,
            "rig": dataclasses.asdict(self.rig),
            "frames": len(self.poses.translation),
            "passes": list(self.passes),
            "light": "uniform",
            "background": "black",
            "renderer": "rasteriser",
            "samples": self.samples**2,
            "world": "metres, y up, facing +z",
            "depth": {"kind": "z", "unit_m": picture_files.DEPTH_UNIT},
            "part_names": list(JOINT_NAMES),
            "released_reference": self.released_reference,
        }


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of a subject."""

    subject: str
    what: str
    """"done", "skipped" (it was there already) or "failed"."""
    why: str = ""
    views: int = 0


def render(job: Job, workers: int = 1) -> Iterator[Outcome]:
    """Render everybody; yields each subject's outcome. One that fails leaves the others alone.

    A subject is skipped where its complete.json is there and all files have the size it notes.

    Raises:
        CaptureFolderError: the folder holds something else.
        ValueError: a pass is unknown, or there is no worker.
        OSError: the folder cannot be written to.
    """
    if unknown := set(job.passes) - set(PASSES) or not job.passes:
        raise ValueError(f"passes {unknown or '()'} cannot be rendered: choose of {', '.join(PASSES)}")
    if workers < 1:
        raise ValueError(f"{workers} workers: one process or more")
    capture_layout.claim(job.out, job.about)
    outcomes: list[Outcome] = []
    for outcome in _outcomes(job, workers):
        outcomes.append(outcome)
        _note(job, outcomes)
        yield outcome
    _note(job, outcomes)


def finished_subjects(root: Path) -> list[str]:
    """Names of the folders with a completion mark."""
    return sorted(path.parent.name for path in root.glob(f"*/{capture_layout.COMPLETE_FILE}"))


def _outcomes(job: Job, workers: int) -> Iterator[Outcome]:
    waiting = []
    for name in job.people:
        if capture_layout.damaged(job.out / name, checksums=False):
            waiting.append(name)
        else:
            yield Outcome(name, "skipped")
    shares = _shares(len(job.poses.translation), math.ceil(workers / max(len(waiting), 1)))
    if workers == 1:
        for name in waiting:
            yield _finish(job, name, [_try(job, name, share) for share in shares])
        return
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(workers, context, begin_worker) as pool:
        tasks = {pool.submit(_try, job, name, share): name for name in waiting for share in shares}
        results: dict[str, list[Outcome]] = {name: [] for name in waiting}
        try:
            for task in concurrent.futures.as_completed(tasks):
                name = tasks[task]
                results[name].append(_result(task, name))
                if len(results[name]) == len(shares):
                    yield _finish(job, name, results[name])
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _shares(frames: int, parts: int) -> list[range]:
    """Frames dealt to workers that share a subject, so that few people keep many cores busy."""
    size = math.ceil(frames / max(1, min(parts, frames)))
    return [range(first, min(first + size, frames)) for first in range(0, frames, size)]


def _result(task: concurrent.futures.Future[Outcome], name: str) -> Outcome:
    try:
        return task.result()
    except concurrent.futures.process.BrokenProcessPool:
        return Outcome(name, "failed", "a worker process was killed: run the same command again, it goes on from here")


def _try(job: Job, name: str, frames: Sequence[int]) -> Outcome:
    """Draw some frames of a subject; errors of input and files become an outcome."""
    try:
        sitting = _sitting(job, name)
        if frames[0] == 0:
            begin(job.out / name, sitting)
        views = sum(1 for _ in draw_frames(job.out / name, sitting, frames, job.passes, job.samples))
        return Outcome(name, "done", views=views)
    except Exception as e:
        failure = describe(e)
        if failure is None:
            raise
        return Outcome(name, "failed", str(failure))


def _sitting(job: Job, name: str) -> Sitting:
    return sit(read_person(job.people[name]), job.poses, job.rig)


def _finish(job: Job, name: str, outcomes: Sequence[Outcome]) -> Outcome:
    failed = next((outcome for outcome in outcomes if outcome.what == "failed"), None)
    if failed is not None:
        return failed
    capture_layout.complete(job.out / name)
    return Outcome(name, "done", views=sum(outcome.views for outcome in outcomes))


def _note(job: Job, outcomes: Sequence[Outcome]) -> None:
    """The list of subjects and the report, as far as it is."""
    capture_layout.write_list(job.out, finished_subjects(job.out))
    report = {
        "done": [outcome.subject for outcome in outcomes if outcome.what == "done"],
        "failed": [{"subject": "", "what": "poses", "why": why} for why in job.unread_poses]
        + [
            {"subject": outcome.subject, "what": "render", "why": outcome.why}
            for outcome in outcomes
            if outcome.what == "failed"
        ],
        "skipped": [outcome.subject for outcome in outcomes if outcome.what == "skipped"],
    }
    with capture_layout.replacing(job.out / f"{job.part}.json") as path:
        path.write_text(json.dumps(report, indent=1), encoding="utf-8")
