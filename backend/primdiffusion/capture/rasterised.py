"""A folder of people -> captures, by the rasteriser, in several processes; what is there already is kept."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import json
import math
import multiprocessing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from primdiffusion.body.model import BodyPose
from primdiffusion.capture.people_files import read_person
from primdiffusion.capture.subject import Sitting, begin, draw_frames, sit
from primdiffusion.failures import describe
from primdiffusion.formats import capture_layout, picture_files
from primdiffusion.formats.camera_rig import Rig
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.worker_process import begin_worker

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
