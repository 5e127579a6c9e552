"""Which poses everybody takes."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..motion.files import MotionFileError, read_motion
from ..motion.motion import Motion
from ..motion.poses import built_in_poses, pick_poses
from .report import Report
from .settings import CaptureSettings


def choose_poses(settings: CaptureSettings, report: Report) -> Motion:
    """The poses [F] of a capture, the same for everybody: near-T first, then built-in ones or a spread of the files'.

    Everybody stands where they stand at rest: where a motion walks to is left out. A file that cannot be used is noted
    in the report. Raises MotionFileError where none can.
    """
    if not settings.pose_files:
        return _in_place(built_in_poses(settings.pose_count))
    motions = []
    for path in settings.pose_files:
        try:
            motions.append(read_motion(path))
            report.notes += [f"{path.name}: {note}" for note in motions[-1].notes]
        except MotionFileError as error:
            report.fail("", "poses", str(error))
    if not motions:
        raise MotionFileError(
            f"none of the {len(settings.pose_files)} pose files can be used: {report.failed[-1]['why']}"
        )
    return _in_place(pick_poses(motions, settings.pose_count, settings.seed))


def _in_place(motion: Motion) -> Motion:
    return dataclasses.replace(motion, translations=np.zeros_like(motion.translations))
