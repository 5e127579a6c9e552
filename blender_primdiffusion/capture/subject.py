"""A subject's folder in a dataset: what is written, what is missing; datasets verified and repaired."""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..formats.arrays import ArrayFileError, read_arrays
from ..formats.camera_files import write_cameras, write_colmap, write_nerf, write_opencv
from ..formats.camera_rig import View
from ..formats.capture_layout import (
    COMPLETE_FILE,
    DATASET_FILE,
    ENDINGS,
    LIST_FILE,
    RELEASED_REFERENCE,
    SMPL_FOLDER,
    SMPL_PLAIN_FILE,
    CaptureFolderError,
    damage,
    picture_path,
    read_about,
    write_joints,
    write_list,
    write_smpl,
)
from ..formats.picture_files import is_whole_picture
from ..motion.motion import Motion


@dataclasses.dataclass(frozen=True, eq=False)
class CapturePlan:
    """A human, its poses and the cameras around it."""

    betas: NDArray[np.float64]
    poses: Motion
    joints: NDArray[np.float64]
    """World [F, 24, 3], metres."""
    views: list[View]


def begin(folder: Path, plan: CapturePlan, layouts: tuple[str, ...]) -> None:
    """Write all files but the pictures and the completion mark.

    Raises CaptureFolderError where the folder holds another human, or other poses.
    """
    poses = plan.poses
    theta = poses.axis_angle().reshape(len(poses), 72)
    smpl = (theta[:, :3], theta[:, 3:], plan.betas, poses.translations)
    _check_same(folder, smpl)
    write_smpl(folder, *smpl)
    write_joints(folder, plan.views, plan.joints)
    write_cameras(folder, plan.views)
    if "opencv" in layouts:
        write_opencv(folder, plan.views)
    for frame in range(len(poses)):
        if "nerf" in layouts:
            write_nerf(folder, plan.views, frame)
        if "colmap" in layouts:
            write_colmap(folder, plan.views, frame)


def is_finished(folder: Path) -> bool:
    """Whether the subject is complete, judged by file sizes. Removes truncated files of an incomplete one.

    The next run then renders only those again.
    """
    wrong = damage(folder, checksums=False)
    if not wrong:
        return True
    remove_damaged(folder, wrong)
    return False


def remove_damaged(folder: Path, wrong: dict[Path, str]) -> None:
    """Remove the files that `capture_layout.damage` names, and first the completion mark."""
    (folder / COMPLETE_FILE).unlink(missing_ok=True)
    for path in wrong:
        if path != folder:
            path.unlink(missing_ok=True)


def is_drawn(folder: Path, kinds: tuple[str, ...], frame: int, camera: int) -> bool:
    """Whether all pictures of a view exist and are whole."""
    return all(is_whole_picture(picture_path(folder, kind, camera, frame)) for kind in kinds)


def finished_subjects(root: Path) -> list[str]:
    """Names of the complete subjects, without the released code's reference, which is one of them."""
    names = (path.parent.name for path in root.glob(f"*/{COMPLETE_FILE}"))
    return sorted(name for name in names if name != RELEASED_REFERENCE)


def list_subjects(root: Path) -> None:
    """Write the list of complete subjects."""
    write_list(root, finished_subjects(root))


def name_reference(root: Path, subject: str) -> None:
    """Link the finished `subject` under the name from which the released code takes its rest sizes."""
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


def _check_same(folder: Path, smpl: tuple[NDArray, ...]) -> None:
    wanted = dict(zip(("global_orient", "body_pose", "betas", "transl"), smpl, strict=True))
    path = folder / SMPL_FOLDER / SMPL_PLAIN_FILE
    try:
        present = read_arrays(path, optional=tuple(wanted)) if path.is_file() else {}
    except ArrayFileError:
        present = {}  # truncated: it is written again
    for name, values in wanted.items():
        values = np.atleast_2d(values)
        if name in present and not (
            present[name].shape == values.shape and np.allclose(present[name], values, atol=1e-5)
        ):
            raise CaptureFolderError(
                f"{folder} holds another person or other poses ({name} differs): choose another folder, or remove it"
            )


def verify(root: Path) -> list[str]:
    """What is wrong with the dataset, a sentence for each file or subject.

    Finished subjects are compared with the sizes and checksums they had, which reads every file. Of unfinished ones
    truncated pictures are named, and how many views are done. Raises CaptureFolderError where there is no
    dataset.
    """
    about = _read_checked(root)
    wrong = []
    for folder in subject_folders(root):
        wrong += [f"{path}: {what}" for path, what in _problems(folder, about).items()]
    return wrong + [f"{root / LIST_FILE}: names {name}, which is not there" for name in _listed_in_vain(root)]


def repair(root: Path) -> list[str]:
    """As `verify`, and removes damaged files and the completion marks of their subjects.

    Rendering the same captures again then renders only those views.
    """
    about = _read_checked(root)
    wrong = verify(root)
    for folder in subject_folders(root):
        problems = _problems(folder, about)
        if problems:
            remove_damaged(folder, {path: what for path, what in problems.items() if path != folder})
        for partial in folder.glob("**/.*.partial.*"):
            partial.unlink(missing_ok=True)
    list_subjects(root)
    return wrong


def subject_folders(root: Path) -> list[Path]:
    """Folders of all subjects, finished or not, sorted."""
    return sorted(
        path
        for path in root.iterdir()
        if path.is_dir() and not path.name.startswith(".") and path.name != RELEASED_REFERENCE
    )


def _read_checked(root: Path) -> dict[str, Any]:
    about = read_about(root)
    numbers = (about.get("frames"), (about.get("rig") or {}).get("count"))
    passes = about.get("passes")
    if not all(isinstance(n, int) and 0 < n <= 10**6 for n in numbers) or not isinstance(passes, list):
        raise CaptureFolderError(
            f"{root / DATASET_FILE} lacks the numbers of frames and cameras: render into a new folder"
        )
    if not set(passes) <= set(ENDINGS):
        raise CaptureFolderError(f"{root / DATASET_FILE} names passes that this program does not know: {passes}")
    return about


def _problems(folder: Path, about: dict[str, Any]) -> dict[Path, str]:
    """What is wrong with one subject, by file; the folder itself stands for what is not finished."""
    wrong = damage(folder)
    pictures = list(_pictures(folder, about))
    if folder not in wrong:
        wrong |= {path: "missing" for path in pictures if not path.is_file()}
        return wrong
    whole = [is_whole_picture(path) for path in pictures]
    cut = {path: "cut short" for path, ok in zip(pictures, whole, strict=True) if not ok and path.is_file()}
    marked = "" if not (folder / COMPLETE_FILE).exists() else f"; its {COMPLETE_FILE} cannot be read"
    return {folder: f"not finished: {sum(whole)} of {len(pictures)} pictures are there{marked}", **cut}


def _pictures(folder: Path, about: dict[str, Any]) -> Iterator[Path]:
    for frame in range(about["frames"]):
        for camera in range(about["rig"]["count"]):
            for kind in about["passes"]:
                yield picture_path(folder, kind, camera, frame)


def _listed_in_vain(root: Path) -> list[str]:
    try:
        names = (root / LIST_FILE).read_text(encoding="utf-8").split()
    except FileNotFoundError:
        return []
    return [name for name in names if not (root / name / COMPLETE_FILE).is_file()]
