"""Find damaged files in captures, and remove them so that the next run renders only what is missing."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..files.picture_files import is_whole_picture
from ..files.regular_files import FileError, check_inside, remove_file
from ..files.whole_files import is_abandoned
from .capture_layout import (
    COMPLETE_FILE,
    DATASET_FILE,
    ENDINGS,
    LIST_FILE,
    RELEASED_REFERENCE,
    damage,
    picture_path,
    read_about,
    read_list,
    write_list,
)

MOST_PICTURES = 1_000_000
"""Of a subject."""


def verify(root: Path, *, checksums: bool = True) -> dict[Path, str]:
    """Return what is wrong with a dataset, by file, or by the folder of an unfinished subject.

    Finished subjects are compared with the sizes and, if `checksums`, the checksums that they had. Raises
    FileError if the folder contains no captures.
    """
    about = _read_checked(root)
    wrong: dict[Path, str] = {}
    for subject in subject_folders(root):
        wrong |= _problems(subject, about, checksums)
        wrong |= dict.fromkeys(_partial_files(subject), "left behind by a killed process")
    path, finished = root / LIST_FILE, finished_subjects(root)
    try:
        differing = set(read_list(root)).symmetric_difference(finished)
    except (OSError, FileError):
        wrong[path] = "cannot be read"
    else:
        if differing:
            wrong[path] = f"differs from the finished subjects by {', '.join(sorted(differing))!s:.160}"
    return wrong


def repair(root: Path, wrong: Collection[Path]) -> None:
    """Remove the files that `verify` has found, with the completion marks of their subjects; rewrite the list.

    The command that rendered the dataset then renders only those files again. Raises FileError, before it
    removes anything, where one of them lies behind a link out of its folder, and OSError.
    """
    for path in wrong:
        check_inside(path, root)
    for subject in subject_folders(root):
        partial = _partial_files(subject)
        damaged = [path for path in wrong if path.is_relative_to(subject) and path not in partial]
        for path in damaged:
            if path != subject:
                check_inside(path, subject)
        if damaged:
            remove_damaged(subject, damaged)
        for path in partial:
            remove_file(path, subject)
    list_subjects(root)


def remove_damaged(subject: Path, wrong: Collection[Path]) -> None:
    """Remove files of a subject, and first the completion mark; the subject's folder itself stays."""
    remove_file(subject / COMPLETE_FILE, subject)
    for path in wrong:
        if path != subject:
            remove_file(path, subject)


def subject_folders(root: Path) -> list[Path]:
    """Sorted folders of subjects, finished or not, without the released code's reference, which repeats one."""
    return sorted(
        path
        for path in root.iterdir()
        if path.is_dir()
        and not path.name.startswith(".")
        and path.name != RELEASED_REFERENCE
        and any((path / mark).exists() for mark in ("cameras.json", COMPLETE_FILE))
    )


def finished_subjects(root: Path) -> list[str]:
    """Sorted names of the subjects with a completion mark."""
    return [path.name for path in subject_folders(root) if (path / COMPLETE_FILE).is_file()]


def list_subjects(root: Path) -> None:
    """Write the list of finished subjects."""
    write_list(root, finished_subjects(root))


def is_complete_view(subject: Path, passes: Sequence[str], camera: int, frame: int) -> bool:
    """Whether all images of a view exist and are complete."""
    return all(is_whole_picture(picture_path(subject, kind, camera, frame)) for kind in passes)


def _read_checked(root: Path) -> dict[str, Any]:
    about, path, remedy = read_about(root), root / DATASET_FILE, "render into a new folder"
    rig, passes = about.get("rig"), about.get("passes")
    frames, cameras = about.get("frames"), rig.get("count") if isinstance(rig, dict) else None
    if not isinstance(frames, int) or not isinstance(cameras, int) or min(frames, cameras) < 1:
        raise FileError(path, "lacks the numbers of frames and cameras", remedy)
    if not isinstance(passes, list) or not all(isinstance(name, str) for name in passes):
        raise FileError(path, "names no passes", remedy)
    if not set(passes) <= set(ENDINGS) or len(passes) > len(ENDINGS):
        raise FileError(path, f"names passes that this program does not know ({passes!r:.80})", remedy)
    if frames * cameras * len(passes) > MOST_PICTURES:
        reason = f"names {frames} frames of {cameras} cameras, more than {MOST_PICTURES} pictures a human"
        raise FileError(path, reason, remedy)
    return about


def _problems(subject: Path, about: Mapping[str, Any], checksums: bool) -> dict[Path, str]:
    wrong = damage(subject, checksums=checksums)
    pictures = list(_pictures(subject, about))
    if subject not in wrong:
        return wrong | {path: "missing" for path in pictures if not path.is_file()}
    whole = [is_whole_picture(path) for path in pictures]
    cut = {path: "cut short" for path, ok in zip(pictures, whole, strict=True) if not ok and path.is_file()}
    marked = f"; its {COMPLETE_FILE} cannot be read" if (subject / COMPLETE_FILE).exists() else ""
    return {subject: f"not finished: {sum(whole)} of {len(pictures)} pictures are there{marked}", **cut}


def _pictures(subject: Path, about: Mapping[str, Any]) -> Iterator[Path]:
    for frame in range(about["frames"]):
        for camera in range(about["rig"]["count"]):
            for kind in about["passes"]:
                yield picture_path(subject, kind, camera, frame)


def _partial_files(subject: Path) -> list[Path]:
    return sorted(path for path in subject.rglob(".*.partial*") if is_abandoned(path))
