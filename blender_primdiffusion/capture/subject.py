"""One person's folder of a dataset: what is there, what is missing, and all files that are not pictures."""

from __future__ import annotations

import dataclasses
import os
import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..formats.arrays import ArrayFileError, read_arrays
from ..formats.camera_files import write_cameras, write_colmap, write_nerf, write_opencv
from ..formats.camera_rig import View
from ..formats.capture_layout import (
    COMPLETE_FILE,
    RELEASED_REFERENCE,
    SMPL_FOLDER,
    SMPL_PLAIN_FILE,
    CaptureFolderError,
    damage,
    picture_path,
    write_joints,
    write_list,
    write_smpl,
)
from ..formats.picture_files import is_whole_picture
from ..motion.motion import Motion


@dataclasses.dataclass(frozen=True, eq=False)
class Sitting:
    """A person, the poses to take and the cameras about them."""

    betas: NDArray[np.float64]
    poses: Motion
    joints: NDArray[np.float64]
    """World [F, 24, 3], metres."""
    views: list[View]


def begin(folder: Path, sitting: Sitting, layouts: tuple[str, ...]) -> None:
    """Write all but the pictures and the completion mark.

    Raises CaptureFolderError where the folder holds another person, or other poses.
    """
    poses = sitting.poses
    theta = poses.axis_angle().reshape(len(poses), 72)
    smpl = (theta[:, :3], theta[:, 3:], sitting.betas, poses.translations)
    _refuse_others(folder, smpl)
    write_smpl(folder, *smpl)
    write_joints(folder, sitting.views, sitting.joints)
    write_cameras(folder, sitting.views)
    if "opencv" in layouts:
        write_opencv(folder, sitting.views)
    for frame in range(len(poses)):
        if "nerf" in layouts:
            write_nerf(folder, sitting.views, frame)
        if "colmap" in layouts:
            write_colmap(folder, sitting.views, frame)


def is_finished(folder: Path) -> bool:
    """Whether the subject is complete, as far as sizes tell. What of it is missing or cut short is taken away.

    Then it is unfinished, and the next run makes just that anew.
    """
    wrong = damage(folder, checksums=False)
    if not wrong:
        return True
    remove_damaged(folder, wrong)
    return False


def remove_damaged(folder: Path, wrong: dict[Path, str]) -> None:
    """Take away what `layout.damage` names and, first, the completion mark that vouches for it."""
    (folder / COMPLETE_FILE).unlink(missing_ok=True)
    for path in wrong:
        if path != folder:
            path.unlink(missing_ok=True)


def is_drawn(folder: Path, kinds: tuple[str, ...], frame: int, camera: int) -> bool:
    """Whether all pictures of a view are there and whole."""
    return all(is_whole_picture(picture_path(folder, kind, camera, frame)) for kind in kinds)


def finished_subjects(root: Path) -> list[str]:
    """Names of the complete subjects; the released code's reference is one of them under another name."""
    names = (path.parent.name for path in root.glob(f"*/{COMPLETE_FILE}"))
    return sorted(name for name in names if name != RELEASED_REFERENCE)


def list_subjects(root: Path) -> None:
    """Write the list of complete subjects anew."""
    write_list(root, finished_subjects(root))


def name_reference(root: Path, subject: str) -> None:
    """Let the finished `subject` be there under the name from which the released code takes its rest sizes."""
    reference = root / RELEASED_REFERENCE
    if subject == RELEASED_REFERENCE or reference.exists():
        return
    try:
        os.symlink(subject, reference, target_is_directory=True)
    except OSError:  # Windows without the right to links, or a disk that has none
        partial = root / f".{RELEASED_REFERENCE}.partial"
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(root / subject, partial)
        os.replace(partial, reference)


def _refuse_others(folder: Path, smpl: tuple[NDArray, ...]) -> None:
    wanted = dict(zip(("global_orient", "body_pose", "betas", "transl"), smpl, strict=True))
    path = folder / SMPL_FOLDER / SMPL_PLAIN_FILE
    try:
        present = read_arrays(path, optional=tuple(wanted)) if path.is_file() else {}
    except ArrayFileError:
        present = {}  # cut short: it is written anew
    for name, values in wanted.items():
        values = np.atleast_2d(values)
        if name in present and not (
            present[name].shape == values.shape and np.allclose(present[name], values, atol=1e-5)
        ):
            raise CaptureFolderError(
                f"{folder} holds another person or other poses ({name} differs): choose another folder, or remove it"
            )
