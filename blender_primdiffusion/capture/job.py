"""A whole capture: everybody, one after the other, view by view. Its caller owns progress, pace and cancelling."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import time
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Protocol

import bpy
import numpy as np

from ..formats.camera_rig import View, bounding_sphere
from ..formats.capture_layout import claim, complete, view_seed
from ..motion.motion import Motion
from .body import Body, read_body
from .inside import cameras_inside
from .passes import write_passes
from .poses import choose_poses
from .report import Report
from .scan import Scan, ScanFile, load_scan
from .settings import CaptureSettings
from .shots import shoot_centres, shoot_colours
from .stage import Stage
from .subject import Sitting, begin, is_drawn, is_finished, list_subjects, name_reference
from .surfaces import mark_parts, prepare_materials

_CENTRE_PASSES = frozenset({"depth", "normal", "part"})
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


class CaptureError(ValueError):
    """Something that cannot be captured; one sentence."""


class Loader(Protocol):
    """Brings a scan into the context's scene."""

    def __call__(self, context: bpy.types.Context, scan_file: ScanFile, body: Body) -> Scan:
        """Raises ScanError."""
        ...


@dataclasses.dataclass(frozen=True)
class Progress:
    """How far a capture is, after a view."""

    subject: str
    frame: int
    camera: int
    done: int
    """Views that need no more work, of this run's `total`."""
    total: int
    eta_s: float | None
    """Seconds that are left; None until a view has been rendered."""
    news: tuple[str, ...] = ()
    """Failures and notes since the step before, a line each."""


Steps = Generator[Progress, None, Report]


def run(
    context: bpy.types.Context,
    settings: CaptureSettings,
    scans: Sequence[ScanFile],
    report: Report | None = None,
    poses: Motion | None = None,
    load: Loader = load_scan,
) -> Steps:
    """Render the shard's part of `scans` in the poses of the settings, or in given ones, a view a step.

    What is done already is skipped, so the same call goes on after a kill, and ends in the same files. A subject that
    fails is noted in the report, which the generator returns, and the others go on; closing the generator cancels, and
    leaves nothing in the file. The user's scene is active between steps. Raises CaptureFolderError, CaptureError for
    poses that are not finite, MotionFileError where there are no poses, and OSError where there is no room left.
    """
    report = Report() if report is None else report
    poses = choose_poses(settings, report) if poses is None else poses
    if not (np.isfinite(poses.rotations).all() and np.isfinite(poses.translations).all()):
        raise CaptureError(f"the poses of {poses.name} hold numbers that are not finite: leave them out")
    claim(settings.out, settings.about(len(poses)))
    body = read_body(settings.body)
    everybody = sorted(scans, key=lambda scan: scan.name)
    index, count = settings.shard
    mine = everybody[index::count]
    clock = _Clock(len(mine) * len(poses) * settings.camera_count, report)
    clock.tell(*(f"{failure['what']}: {failure['why']}" for failure in report.failed))
    try:
        for scan_file in mine:
            yield from _try_subject(context, settings, scan_file, poses, body, load, clock)
            if settings.released_reference and scan_file is everybody[0] and scan_file.name in report.done:
                name_reference(settings.out, scan_file.name)
            report.write(settings.out, settings.shard)
    finally:
        list_subjects(settings.out)
        report.write(settings.out, settings.shard)
    return report


def _try_subject(context, settings, scan_file, poses, body, load, clock: _Clock) -> Generator[Progress, None, None]:
    folder, report = settings.out / scan_file.name, clock.report
    clock.begin(scan_file.name)
    views = len(poses) * settings.camera_count
    if is_finished(folder):
        report.skipped.append(scan_file.name)
        yield clock.skip_rest(views)
        return
    try:
        yield from _capture(context, settings, scan_file, poses, body, load, clock)
        complete(folder)
        report.done.append(scan_file.name)
        list_subjects(settings.out)
    except OSError as error:
        clock.tell(report.fail(scan_file.name, "capture", str(error)))
        if error.errno in _NO_ROOM:
            raise
    except Exception as error:  # a batch of days must not end for one scan, whatever is wrong with it
        known = isinstance(error, (ValueError, RuntimeError))
        why = str(error) if known and str(error) else f"{type(error).__name__}: {error}"
        clock.tell(report.fail(scan_file.name, "capture", why))
    yield clock.skip_rest(views)


def _capture(context, settings, scan_file, poses, body, load, clock: _Clock) -> Generator[Progress, None, None]:
    folder = settings.out / scan_file.name
    with contextlib.closing(Stage(context, settings)) as stage:
        clock.tell_once(stage.device_note)
        with stage.entered() as own:
            scan = load(own, scan_file, body)
            clock.tell(*(f"{scan_file.name}: {note}" for note in scan.notes))
            for thing in scan.objects:
                mark_parts(thing, scan.joint_of_group)
            prepare_materials(scan.objects, unlit=settings.light == "uniform")
            views = list(settings.cameras) or _views_about(scan, settings, poses)
            joints = np.stack([scan.pose(*pose) for pose in zip(poses.rotations, poses.translations, strict=True)])
        begin(folder, Sitting(scan.betas, poses, joints, views), settings.layouts)
        for frame in range(len(poses)):
            missing = [camera for camera in range(len(views)) if not is_drawn(folder, settings.kinds, frame, camera)]
            if missing:
                with stage.entered() as own:
                    scan.pose(poses.rotations[frame], poses.translations[frame])
                    _refuse_inside(scan, own, views, frame)
            for camera, view in enumerate(views):
                if camera in missing:
                    with clock.rendering():
                        _shoot(stage, settings, folder, view, (frame, camera))
                yield clock.step(frame, camera)


def _views_about(scan: Scan, settings: CaptureSettings, poses: Motion) -> list[View]:
    return settings.rig.views(*bounding_sphere(scan.bounds(poses.rotations, poses.translations)))


def _refuse_inside(scan: Scan, context: bpy.types.Context, views: list[View], frame: int) -> None:
    inside = cameras_inside(scan.objects, context.evaluated_depsgraph_get(), views)
    if inside:
        raise CaptureError(
            f"camera {inside[0]} is inside the person in frame {frame}: move it away, or give the rig a larger margin"
        )


def _shoot(stage: Stage, settings: CaptureSettings, folder: Path, view: View, where: tuple[int, int]) -> None:
    seed = view_seed(settings.seed, folder.name, *where)
    kinds = settings.kinds
    colours = shoot_colours(stage, view, seed, settings.samples) if set(kinds) - _CENTRE_PASSES else None
    centres = shoot_centres(stage, view, seed) if set(kinds) & _CENTRE_PASSES else None
    write_passes(folder, kinds, where, colours, centres)


class _Clock:
    """Counts views, times those that are rendered, and keeps news until the next step."""

    def __init__(self, total: int, report: Report):
        self.report = report
        self._total, self._done, self._rendered, self._seconds = total, 0, 0, 0.0
        self._subject, self._of_subject = "", 0
        self._news: list[str] = []
        self._told: set[str] = set()

    def begin(self, subject: str) -> None:
        self._subject, self._of_subject = subject, 0

    @contextlib.contextmanager
    def rendering(self):
        began = time.monotonic()
        yield
        self._seconds += time.monotonic() - began
        self._rendered += 1

    def tell(self, *news: str) -> None:
        self._news += news

    def tell_once(self, news: str) -> None:
        if news not in self._told:
            self._told.add(news)
            self.tell(news)

    def step(self, frame: int, camera: int) -> Progress:
        self._done += 1
        self._of_subject += 1
        return self._progress(frame, camera)

    def skip_rest(self, views: int) -> Progress:
        """The subject, of so many views, needs no more work."""
        self._done += views - self._of_subject
        self._of_subject = views
        return self._progress(-1, -1)

    def _progress(self, frame: int, camera: int) -> Progress:
        left = self._total - self._done
        eta_s = left * self._seconds / self._rendered if self._rendered else None
        news, self._news = tuple(self._news), []
        return Progress(self._subject, frame, camera, self._done, self._total, eta_s, news)
