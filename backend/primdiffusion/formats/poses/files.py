"""Read poses and motion from AMASS, npz, npy, JSON and BVH files; write AMASS files."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import ArrayFileError, array_names, read_arrays, read_npy
from ..json_files import read_json
from ..motion_size import MotionTooLongError, check_motion_size
from ..regular_files import TooLargeError
from ..rotations import first_improper, improper_text
from .axes import axis_direction, axis_name, find_up, turn_y_up
from .bvh import BvhError, read_bvh
from .motion import LARGEST_NUMBER, Detected, Motion
from .rotation import from_axis_angle, nearest

MOST_NUMBERS = 40_000_000
"""Of an array: an hour of SMPL-X at 60 frames/s has 36 million."""
LARGEST_FPS, SMALLEST_FPS = 10_000.0, 0.1
DEFAULT_FPS = 30.0
"""Frame rate of motion whose file does not state it."""
_POSES = ("poses", "pose", "theta", "fullpose")
_ROOT, _REST = ("global_orient", "root_orient"), ("body_pose", "pose_body")
_TRANSLATIONS = ("trans", "transl", "translation")
_RATES = ("mocap_framerate", "mocap_frame_rate", "fps", "framerate")
POSE_KEYS = (*_POSES, *_ROOT, *_REST, *_TRANSLATIONS, *_RATES)
"""Names of arrays in pose files."""
UP_AXES = ("", "x", "-x", "y", "-y", "z", "-z")
"""Axes that may point up in a file; the empty one stands for detection."""
_BODIES = {24: "SMPL", 22: "SMPL without hands", 52: "SMPL-H", 55: "SMPL-X"}
_BODY_JOINTS = 22
"""Joints before the hands, the same in SMPL, SMPL-H and SMPL-X."""


class MotionFileError(ValueError):
    """A file of poses cannot be used; the message says what is wrong and what to do."""


def read_motion(path: str | Path, up: str = "", bones: Mapping[str, str] | None = None) -> Motion:
    """The motion in a file, y up.

    `up` is the file's axis that points up ("y", "-z", ...), detected where empty; `bones` maps SMPL's joints to the
    bones of a .bvh, likewise.

    - .npz of AMASS: `poses` [F, 72 | 156 | 165] (SMPL, SMPL-H, SMPL-X; fingers, jaw and eyes are left out), `trans`,
      `mocap_framerate`, `mocap_frame_rate` or `fps`. z should be up; the actual axis is detected from the pelvis.
    - .npz of poses, y up: `global_orient` with `body_pose`, or `pose`; axis-angle or matrices; `transl` is optional.
    - .npy: [F, 72], [72], [F, 24, 3] or [F, 24, 3, 3]. .json: the same as lists, or an object with the names above.
    - .bvh: any rig that `rigs` knows.

    Without a frame rate it is `DEFAULT_FPS`, with a note. Raises MotionFileError where there is no such file, or it
    holds pickles, NaN or other data.
    """
    path = Path(path)
    if not path.is_file():
        raise MotionFileError(f"there is no pose file {path}: check the path")
    if up not in UP_AXES:
        raise MotionFileError(f"the axis {up!r} cannot be up: give one of {_listed(list(UP_AXES[1:]))}")
    readers = {".npz": _read_npz, ".npy": _read_npy, ".json": _read_json}
    suffix = path.suffix.lower()
    axes = np.eye(3)
    try:
        if suffix == ".bvh":
            (motion, axes), detect_up = read_bvh(path, bones), True
        elif suffix in readers:
            motion, detect_up = readers[suffix](path)
        else:
            raise MotionFileError(f"{path} is no pose file: .npz, .npy, .json and .bvh files are")
    except (ArrayFileError, BvhError) as e:
        raise MotionFileError(str(e)) from e
    except TooLargeError as e:
        raise MotionFileError(str(e)) from e
    except OSError as e:
        raise MotionFileError(f"{path} cannot be read ({e.strerror or e}): check that it may be opened") from e
    if up:
        return _turned(motion, axis_name(axes @ axis_direction(up)), up)
    return _upright(motion, axes) if detect_up else motion


def _read_npz(path: Path) -> tuple[Motion, bool]:
    """The motion as it is in the file, and whether its up axis must be detected."""
    names = array_names(path)
    arrays = read_arrays(path, optional=POSE_KEYS)
    if "smpl" in names and not any(key in arrays for key in (*_POSES, *_REST)):
        raise MotionFileError(f"{path} holds pickled objects, which are never read: use the version with plain arrays")
    if not any(key in arrays for key in (*_POSES, *_REST)):
        raise MotionFileError(
            f"{path} holds no poses: it holds {_listed(names)} and needs 'poses', or 'global_orient' and 'body_pose'"
        )
    return motion_from_arrays(arrays, path), _is_amass(arrays)


def _is_amass(arrays: Mapping[str, NDArray]) -> bool:
    return "trans" in arrays and ("poses" in arrays or "pose_body" in arrays)


def _read_npy(path: Path) -> tuple[Motion, bool]:
    return motion_from_arrays({"pose": read_npy(path)}, path), False


def _read_json(path: Path) -> tuple[Motion, bool]:
    try:
        content = read_json(path)
    except (ValueError, OSError) as e:
        raise MotionFileError(f"{path} is not JSON that can be read ({e!s:.120}): export it again") from e
    if not isinstance(content, dict):
        content = {"pose": content}
    try:
        arrays = {key: np.asarray(content[key], np.float64) for key in POSE_KEYS if key in content}
    except (ValueError, TypeError, OverflowError) as e:
        raise MotionFileError(f"{path} holds something else than lists of numbers of equal length ({e!s:.80})") from e
    if not any(key in arrays for key in (*_POSES, *_REST)):
        raise MotionFileError(f"{path} holds no poses: it needs 'pose', or 'global_orient' and 'body_pose'")
    return motion_from_arrays(arrays, path), False


def motion_from_arrays(arrays: Mapping[str, NDArray], path: Path) -> Motion:
    """A motion from arrays with the usual names, axes unchanged; errors name `path`.

    Raises MotionFileError where the arrays are no poses.
    """
    for key, array in arrays.items():
        if array.dtype.kind not in "iuf":
            raise MotionFileError(f"{path}: {key!r} holds {array.dtype} instead of numbers")
        if array.size == 0:
            raise MotionFileError(f"{path}: {key!r} holds no frame; export the motion again")
        try:
            check_motion_size(path, array.size)
        except MotionTooLongError as e:
            raise MotionFileError(str(e)) from e
        if not np.isfinite(array).all():
            raise MotionFileError(f"{path}: {key!r} holds NaN or infinite numbers; export the motion again")
        if array.size > MOST_NUMBERS or np.abs(array.astype(np.float64)).max() > LARGEST_NUMBER:
            raise MotionFileError(
                f"{path}: {key!r} holds more than {MOST_NUMBERS} numbers, or one above {LARGEST_NUMBER:g}; cut the "
                "motion into pieces, or export it again"
            )
    rest = _first(arrays, _REST)
    if rest is None:
        given = _matrices(_given(arrays, _POSES), path)
        rotations, joints = _rotations(given, path), given.shape[1]
    else:
        given = _matrices(rest, path, joints_before=1)
        body, joints = _rotations(given, path, joints_before=1), given.shape[1] + 1
        root = _first(arrays, _ROOT)
        if root is not None:
            if root.ndim == 3 and root.shape[1:] == (3, 3):
                root = root[:, None]  # a matrix a frame
            first = _matrices(root, path)[:, 0]
            if len(first) not in (1, len(body)):
                raise MotionFileError(f"{path}: {len(first)} frames of global_orient but {len(body)} of body_pose")
            body[:, 0] = first
        rotations = body
    frames, notes = len(rotations), []
    translations = _first(arrays, _TRANSLATIONS)
    translations = np.zeros((frames, 3)) if translations is None else np.asarray(translations, np.float64)
    if translations.size not in (3, 3 * frames):
        raise MotionFileError(f"{path}: {frames} frames of poses but translations of shape {translations.shape}")
    translations = np.array(np.broadcast_to(translations.reshape(-1, 3), (frames, 3)))
    rate = _first(arrays, _RATES)
    stated = float(rate.ravel()[0]) if rate is not None and rate.size == 1 and float(rate.ravel()[0]) > 0 else 0.0
    if stated and not SMALLEST_FPS <= stated <= LARGEST_FPS:
        raise MotionFileError(f"{path} states {stated:g} frames per second; export the motion again")
    if not stated and frames > 1:
        notes.append(f"states no frame rate: {DEFAULT_FPS:g} frames per second are assumed")
    detected = Detected(rig=_BODIES.get(joints, f"{joints} joints"), up="y", fps=stated)
    return Motion(rotations, translations, stated or DEFAULT_FPS, path.stem, tuple(notes), detected)


def _upright(motion: Motion, axes: NDArray) -> Motion:
    """The motion with its detected up axis turned to y; `axes` is the rotation from the file's axes so far."""
    up = find_up(motion.rotations[:, 0])
    if not up:
        unknown = dataclasses.replace(motion.detected, up="")
        note = "does not state which axis is up: y is assumed"
        return dataclasses.replace(motion, notes=(*motion.notes, note), detected=unknown)
    return _turned(motion, up, axis_name(axes.T @ axis_direction(up)))


def _turned(motion: Motion, up: str, in_file: str) -> Motion:
    rotations, translations = turn_y_up(motion.rotations, motion.translations, up)
    return dataclasses.replace(
        motion,
        rotations=rotations,
        translations=translations,
        notes=(*motion.notes, f"{in_file} is up in the file"),
        detected=dataclasses.replace(motion.detected, up=in_file),
    )


def _rotations(given: NDArray, path: Path, joints_before: int = 0) -> NDArray[np.float64]:
    """Rotations [F, 24, 3, 3] from matrices [F, n, 3, 3] without the first `joints_before` joints; missing joints get
    the identity.

    SMPL-H and SMPL-X have fingers instead of SMPL's two hand joints, so only the body's 22 joints are used.
    """
    count = given.shape[1] + joints_before
    if count == 24:
        taken = 24
    elif count == _BODY_JOINTS or count > 24:
        taken = _BODY_JOINTS
    else:
        raise MotionFileError(
            f"{path} holds poses of {count} joints (shape {given.shape}): needed are SMPL's 24, 22 without hands, or "
            "those of SMPL-H or SMPL-X"
        )
    rotations = np.tile(np.eye(3), (len(given), 24, 1, 1))
    rotations[:, joints_before:taken] = given[:, : taken - joints_before]
    return rotations


def _matrices(values: NDArray, path: Path, joints_before: int = 0) -> NDArray[np.float64]:
    """Rotation matrices [F, n, 3, 3] of axis-angle numbers [3 n], [F, 3 n], [F, n, 3], or of matrices [F, n, 3, 3]."""
    values = np.asarray(values, np.float64)
    if values.ndim in (3, 4) and values.shape[-2:] == (3, 3):
        given = values if values.ndim == 4 else values[None]
        improper = first_improper(given)
        if improper is not None:
            raise MotionFileError(
                f"{path} holds {improper_text(improper[0], improper[1] + joints_before)}; export the poses again"
            )
        return nearest(given)
    if values.ndim == 1:
        values = values[None]
    if values.ndim == 2 and values.shape[1] == 3 and values.shape[0] in (_BODY_JOINTS, 23, 24, 52, 55):
        values = values.reshape(1, -1)  # one pose, a row a joint
    if values.ndim not in (2, 3) or values.shape[-1] % 3 or (values.ndim == 3 and values.shape[-1] != 3):
        raise MotionFileError(
            f"{path} holds poses of shape {values.shape}: needed are 72 axis-angle numbers a frame (24 joints x 3)"
        )
    return from_axis_angle(values.reshape(len(values), -1, 3))


def _first(arrays: Mapping[str, NDArray], keys: Iterable[str]) -> NDArray | None:
    return next((arrays[key] for key in keys if key in arrays), None)


def _given(arrays: Mapping[str, NDArray], keys: Iterable[str]) -> NDArray[Any]:
    return next(arrays[key] for key in keys if key in arrays)


def _listed(names: list[str]) -> str:
    return ", ".join(f"{name[:16]!r}" for name in names[:8]) or "nothing"
