"""A whole capture, subject by subject and view by view. Its caller controls pace and cancelling."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import os
import shutil
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..console import Report
from ..files.regular_files import FileError, check_unlinked
from ..files.whole_files import remove_abandoned, temporary_folder
from ..formats.camera_rig import View, bounding_sphere
from ..formats.capture_layout import (
    RELEASED_REFERENCE,
    claim,
    complete,
    is_complete,
    is_complete_view,
    list_subjects,
    view_seed,
    write_cameras,
    write_joints,
    write_smpl,
)
from ..formats.poses.files import read_motion
from ..formats.poses.motion import Motion
from ..formats.poses.skeleton import joint_positions
from ..formats.requests import FLOAT_DEPTH
from ..motion.poses import built_in_poses, pick_poses
from .body import Body, read_body
from .group import Placed, groups_of, place_group
from .passes import write_passes
from .scan import Scan, load_scan
from .scan_files import ScanFile
from .settings import CaptureSettings
from .stage import CaptureScene, shoot_centres, shoot_colours
from .surfaces import mark_parts, prepare_materials


def choose_poses(settings: CaptureSettings, report: Report) -> Motion:
    """The poses [F] of a capture, for all subjects: near-T first, then built-in ones or a spread of the files'.

    Subjects stay in place: translations are left out. A file that cannot be used is noted
    in the report. Raises ValueError where none can.
    """
    if not settings.pose_files:
        return _in_place(built_in_poses(settings.pose_count))
    motions = []
    for path in settings.pose_files:
        try:
            motions.append(read_motion(path))
            if doubt := motions[-1].detected.doubt:
                report.notes.append(f"{path.name}: {doubt}")
        except FileError as error:
            report.fail("", "poses", str(error))
    if not motions:
        raise ValueError(f"none of the {len(settings.pose_files)} pose files can be used: {report.failed[-1]['why']}")
    return _in_place(pick_poses(motions, settings.pose_count, settings.seed))


def _in_place(motion: Motion) -> Motion:
    return dataclasses.replace(motion, translations=np.zeros_like(motion.translations))


_CENTRE_PASSES = frozenset({"depth", FLOAT_DEPTH, "normal", "part"})
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


Loader = Callable[[bpy.types.Context, ScanFile, Body], Scan]
"""Loads a scan into the context's scene. Raises FileError."""


@dataclasses.dataclass(frozen=True)
class CaptureProgress:
    """Progress of a capture after a view."""

    subject: str
    frame: int
    camera: int
    done: int
    """Finished views, of this run's `total`."""
    total: int
    eta_s: float | None
    """Seconds left; None until a view has been rendered."""
    news: tuple[str, ...] = ()
    """Failures and notes since the last step, a line each."""


Steps = Generator[CaptureProgress, None, Report]


def run(
    context: bpy.types.Context,
    settings: CaptureSettings,
    scans: Sequence[ScanFile],
    report: Report | None = None,
    poses: Motion | None = None,
    load: Loader = load_scan,
) -> Steps:
    """Render the shard's part of `scans` in the poses of the settings, or in given ones, a view a step.

    Finished views are skipped, so the same call resumes after a kill and ends in the same files. A subject that fails
    is noted in the report, which the generator returns; closing the generator cancels, and leaves nothing in the file.
    The user's scene is active between steps. Raises FileError, ValueError for poses that are not finite and where there
    are no poses, and OSError where the disk is full.
    """
    report = Report() if report is None else report
    poses = choose_poses(settings, report) if poses is None else poses
    if not (np.isfinite(poses.rotations).all() and np.isfinite(poses.translations).all()):
        raise ValueError(f"the poses of {poses.name} hold numbers that are not finite: leave them out")
    claim(settings.out, settings.about(len(poses)))
    body = read_body(settings.body)
    ordered = sorted(scans, key=lambda scan: scan.name)
    index, count = settings.shard
    mine = ordered[index::count]
    places = _Places(context, settings, ordered, poses, body, load)
    clock = _Clock(len(mine) * len(poses) * settings.camera_count, report)
    clock.note(*(f"{failure['what']}: {failure['why']}" for failure in report.failed))
    try:
        for scan_file in mine:
            yield from _try_subject(context, settings, scan_file, places, body, load, clock)
            if settings.released_reference and scan_file is ordered[0] and scan_file.name in report.done:
                _name_reference(settings.out, scan_file.name)
            report.write(settings.out, settings.shard)
    finally:
        list_subjects(settings.out)
        report.write(settings.out, settings.shard)
    return report


class _Places:
    """Poses of every subject, and cameras where a group shares them; groups are measured once."""

    def __init__(self, context, settings: CaptureSettings, ordered: Sequence[ScanFile], poses: Motion, body, load):
        self.frames = len(poses)
        self._place = lambda group: place_group(context, settings, group, poses, body, load)
        self._alone = None if settings.together > 1 else Placed(poses, list(settings.cameras), "")
        self._groups = list(groups_of(ordered, settings.together))
        self._placed: dict[str, Placed] = {}

    def of(self, scan_file: ScanFile) -> Placed:
        """Raises FileError where one of the group cannot be loaded."""
        if self._alone is not None:
            return self._alone
        if scan_file.name not in self._placed:
            self._placed = self._place(next(group for group in self._groups if scan_file in group))
        return self._placed[scan_file.name]


def _try_subject(
    context, settings, scan_file, places: _Places, body, load, clock: _Clock
) -> Generator[CaptureProgress, None, None]:
    folder, report = settings.out / scan_file.name, clock.report
    clock.begin(scan_file.name)
    views = places.frames * settings.camera_count
    if is_complete(folder):
        report.skipped.append(scan_file.name)
        yield clock.skip_rest(views)
        return
    try:
        check_unlinked(folder)
        yield from _capture(context, settings, scan_file, places.of(scan_file), body, load, clock)
        complete(folder)
        report.done.append(scan_file.name)
        list_subjects(settings.out)
    except OSError as error:
        clock.note(report.fail(scan_file.name, "capture", str(error)))
        if error.errno in _DISK_FULL:
            raise
    except Exception as error:  # one bad scan must not end a batch of days
        known = isinstance(error, (ValueError, RuntimeError))
        why = str(error) if known and str(error) else f"{type(error).__name__}: {error}"
        clock.note(report.fail(scan_file.name, "capture", why))
    yield clock.skip_rest(views)


def _name_reference(root: Path, subject: str) -> None:
    """Link the finished `subject` under the name from which the released code takes its rest sizes."""
    reference = root / RELEASED_REFERENCE
    if subject == RELEASED_REFERENCE or os.path.lexists(reference):
        return
    try:
        os.symlink(subject, reference, target_is_directory=True)
    except OSError:  # Windows without the right to links, or a disk that has none
        remove_abandoned(root, reference)
        with temporary_folder(reference) as partial:
            shutil.copytree(root / subject, partial / subject)
            os.replace(partial / subject, reference)


def _capture(
    context, settings, scan_file, placed: Placed, body, load, clock: _Clock
) -> Generator[CaptureProgress, None, None]:
    folder, poses = settings.out / scan_file.name, placed.poses
    with contextlib.closing(CaptureScene(context, settings)) as stage:
        clock.note_once(stage.device_note)
        with stage.entered() as own:
            scan = load(own, scan_file, body)
            clock.note(*(f"{scan_file.name}: {note}" for note in scan.notes))
            for obj in scan.objects:
                mark_parts(obj, scan.joint_of_group)
            prepare_materials(scan.objects, unlit=settings.light == "uniform")
            placing = poses.rotations, poses.translations
            views = placed.views or settings.rig.views(*bounding_sphere(scan.bounds(*placing)))
            joints = np.stack([scan.pose(*pose) for pose in zip(*placing, strict=True)])
        theta = poses.axis_angle().reshape(len(poses), 72)
        write_smpl(folder, theta[:, :3], theta[:, 3:], scan.betas, poses.translations)
        write_joints(folder, views, joints, _body_joints(body, scan.betas, poses))
        write_cameras(folder, views)
        for frame in range(len(poses)):
            missing = [
                camera for camera in range(len(views)) if not is_complete_view(folder, settings.kinds, camera, frame)
            ]
            if missing:
                with stage.entered():
                    scan.pose(poses.rotations[frame], poses.translations[frame])
            for camera, view in enumerate(views):
                if camera in missing:
                    with clock.rendering():
                        stage.choose_hdri(view_seed(settings.seed, placed.first or scan_file.name, frame, camera))
                        _shoot(stage, settings, folder, view, (frame, camera))
                yield clock.step(frame, camera)


def _body_joints(body: Body, betas: NDArray, poses: Motion) -> NDArray[np.float64]:
    """Joints [F, 24, 3] of the fitted body."""
    return joint_positions(poses.rotations, poses.translations, body.rest(betas)[1])


def _shoot(stage: CaptureScene, settings: CaptureSettings, folder: Path, view: View, where: tuple[int, int]) -> None:
    seed = view_seed(settings.seed, folder.name, *where)
    kinds = settings.kinds
    colours = shoot_colours(stage, view, seed, settings.samples) if set(kinds) - _CENTRE_PASSES else None
    centres = shoot_centres(stage, view, seed) if set(kinds) & _CENTRE_PASSES else None
    write_passes(folder, kinds, where, colours, centres)


class _Clock:
    """Counts views, times renders, and collects notes until the next step."""

    def __init__(self, total: int, report: Report):
        self.report = report
        self._total, self._done, self._rendered, self._seconds = total, 0, 0, 0.0
        self._subject, self._of_subject = "", 0
        self._news: list[str] = []
        self._noted: set[str] = set()

    def begin(self, subject: str) -> None:
        self._subject, self._of_subject = subject, 0

    @contextlib.contextmanager
    def rendering(self):
        began = time.monotonic()
        yield
        self._seconds += time.monotonic() - began
        self._rendered += 1

    def note(self, *news: str) -> None:
        self._news += news

    def note_once(self, news: str) -> None:
        if news not in self._noted:
            self._noted.add(news)
            self.note(news)

    def step(self, frame: int, camera: int) -> CaptureProgress:
        self._done += 1
        self._of_subject += 1
        return self._progress(frame, camera)

    def skip_rest(self, views: int) -> CaptureProgress:
        """Count the subject's remaining views as done."""
        self._done += views - self._of_subject
        self._of_subject = views
        return self._progress(-1, -1)

    def _progress(self, frame: int, camera: int) -> CaptureProgress:
        left = self._total - self._done
        eta_s = left * self._seconds / self._rendered if self._rendered else None
        news, self._news = tuple(self._news), []
        return CaptureProgress(self._subject, frame, camera, self._done, self._total, eta_s, news)
