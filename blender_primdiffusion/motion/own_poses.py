"""The user's own poses: a folder with a JSON file and a picture for each, which can be copied to other computers."""

from __future__ import annotations

import contextlib
import json
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..formats.json_files import read_json
from ..formats.regular_files import FileError
from ..formats.removing import remove_file
from ..formats.whole_files import write_atomically

SUFFIX = ".pose.json"
PICTURE_SUFFIX = ".pose.png"
_LONGEST_NAME = 60
_LARGEST_NUMBER = 1e6


def own_poses(folder: Path) -> dict[str, Path]:
    """The poses in a folder, sorted: name -> file; none where the folder does not exist."""
    return {path.name.removesuffix(SUFFIX): path for path in sorted(folder.glob(f"*{SUFFIX}"))}


def picture_of(pose: Path) -> Path:
    """Path of the picture beside the file of a pose, which need not exist."""
    return pose.with_name(pose.name.removesuffix(SUFFIX) + PICTURE_SUFFIX)


def delete_pose(pose: Path) -> None:
    """Remove the file of a pose, with its picture. Raises OSError where the file stays."""
    remove_file(pose, pose.parent)
    with contextlib.suppress(OSError):  # without the pose it is not shown
        remove_file(picture_of(pose), pose.parent)


def save_pose(folder: Path, name: str, pose: NDArray, translation: NDArray) -> Path:
    """Write a pose [24, 3] (axis-angle, radians) with its translation [3] (metres), both y up; returns the file.

    `formats.poses.files` reads the file too (`pose`, `transl`). Raises FileError for a name that is empty, taken or
    no valid file name, and where the folder cannot be written to.
    """
    name = name.strip()
    if not name or len(name) > _LONGEST_NAME or re.search(r'[\\/:*?"<>|\x00-\x1f]', name) or name.startswith("."):
        raise FileError(
            f"a pose cannot be called {name!r}: give it a name of at most {_LONGEST_NAME} letters without any of "
            r'\ / : * ? " < > |'
        )
    path = folder / f"{name}{SUFFIX}"
    if path.exists():
        raise FileError(f"there is a pose {name!r} already: give another name, or delete that one first")
    content = {"name": name, "pose": np.round(pose, 6).tolist(), "transl": np.round(translation, 6).tolist()}
    try:
        write_atomically(path, json.dumps(content, indent=1))
    except OSError as error:
        raise FileError(f"the pose could not be written to {str(path)!r} ({error.strerror or error})") from error
    return path


def load_pose(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The pose [24, 3] and the translation [3] in a file. Raises FileError where there is none."""
    try:
        content = read_json(path)
        pose = np.asarray(content["pose"], np.float64)
        translation = np.asarray(content["transl"], np.float64)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileError(f"the pose file {str(path)!r} cannot be read ({error!s:.160}): save the pose again") from error
    finite = all((np.abs(values) < _LARGEST_NUMBER).all() for values in (pose, translation))  # false for NaN
    if pose.shape != (24, 3) or translation.shape != (3,) or not finite:
        raise FileError(f"the pose file {str(path)!r} holds no pose of 24 joints: save the pose again")
    return pose, translation
