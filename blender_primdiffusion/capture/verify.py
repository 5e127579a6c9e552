"""Whether a dataset is whole; and taking away what is not, so that the next run makes just that anew."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..formats.capture_layout import (
    COMPLETE_FILE,
    DATASET_FILE,
    ENDINGS,
    LIST_FILE,
    RELEASED_REFERENCE,
    CaptureFolderError,
    damage,
    picture_path,
    read_about,
)
from ..formats.picture_files import is_whole_picture
from .subject import list_subjects, remove_damaged


def verify(root: Path) -> list[str]:
    """What is wrong with the dataset, a sentence a file or subject; empty where all of it is whole.

    Finished subjects are compared with the sizes and checksums they had, which reads every file. Of unfinished ones
    pictures that are cut short are named, and how many views are done. Raises CaptureFolderError where there is no
    dataset.
    """
    about = _read_checked(root)
    wrong = []
    for folder in subject_folders(root):
        wrong += [f"{path}: {what}" for path, what in _problems(folder, about).items()]
    return wrong + [f"{root / LIST_FILE}: names {name}, which is not there" for name in _listed_in_vain(root)]


def repair(root: Path) -> list[str]:
    """As `verify`, and takes away what is damaged and the completion marks of whom it belongs to.

    Nothing else is touched; render the same captures again, and just these views are rendered.
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
    """Everybody of a dataset, finished or not, sorted."""
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
    """What is wrong with one subject, by files; the folder itself stands for what is still to do."""
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
