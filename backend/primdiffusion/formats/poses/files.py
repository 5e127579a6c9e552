"""The one reader of poses and motion: AMASS, npz, npy, JSON, pickles, BVH, trackers; and the writer of AMASS.

Arrays in a tracker's output may be one level down, or divided by frames:

- GVHMR: `smpl_params_global`, beside the same in a camera's axes;
- WHAM, VIBE: a person's arrays by the person's number; `pose_world` and `trans_world` rather than a camera's;
- PHALP, 4D-Humans' track.py: frames by the picture's name, with the numbers of the people in it (`tid`) and their
  `smpl`, in a camera's axes.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...files.arrays import array_names, read_arrays, read_npy
from ...files.json_files import read_json
from ...files.regular_files import FileError, read_regular
from ...files.smpl_pickle import Stored, as_array, load_restricted
from ...files.whole_files import atomic_replace
from .bvh import read_bvh
from .motion import (
    DEFAULT_FPS,
    RATES,
    Detected,
    Motion,
    check_motion_size,
    check_numbers,
    first_of,
    stated_rate,
)
from .rotation import (
    about_axis,
    axis_direction,
    axis_name,
    find_up,
    first_improper,
    from_axis_angle,
    improper_text,
    nearest,
    pelvis_up,
    to_axis_angle,
    turn_y_up,
)
from .skeleton import REST_JOINTS

LARGEST_PICKLE = 64 * 2**20
"""Bytes of a .pkl."""
_POSES = ("pose_world", "poses", "pose", "theta", "fullpose")
_ROOT, _REST = ("global_orient", "root_orient"), ("body_pose", "pose_body")
_TRANSLATIONS = ("trans_world", "trans", "transl", "translation")
POSE_KEYS = (*_POSES, *_ROOT, *_REST, *_TRANSLATIONS, *RATES)
"""Names of arrays in pose files."""
_HOLDING = (*_POSES, *_REST)
"""Arrays of which a person has at least one."""
ENDINGS = (".npz", ".npy", ".json", ".pkl", ".bvh")
"""Endings of the files that are read."""
UP_AXES = ("", "x", "-x", "y", "-y", "z", "-z")
"""Axes that may point up in a file; the empty one stands for detection."""
_BODIES = {24: "SMPL", 22: "SMPL without hands", 52: "SMPL-H", 55: "SMPL-X"}
_MOST_TRIED = 2000
"""Frames by which the up axis is found."""
_BODY_JOINTS = 22
"""Joints before the hands, the same in SMPL, SMPL-H and SMPL-X."""


def read_motion(path: str | Path, up: str = "", person: str = "") -> Motion:
    """The motion in a file, y up.

    `up` is the file's axis that points up ("y", "-z", ...), detected where empty. `person` is one of several
    in a tracker's output (`Detected.people`); where it is empty, who has the most frames.

    - .npz of AMASS: `poses` [F, 72 | 156 | 165] (SMPL, SMPL-H, SMPL-X; fingers, jaw and eyes are left out), `trans`,
      `mocap_framerate`, `mocap_frame_rate` or `fps`. z should be up; the actual axis is detected from the pelvis.
    - .npz of poses, y up: `global_orient` with `body_pose`, or `pose`; axis-angle or matrices; `transl` is optional.
    - .npy: [F, 72], [72], [F, 24, 3] or [F, 24, 3, 3]. .json: the same as lists, or an object with the names above.
    - .pkl: a dictionary of such arrays, as estimators of SMPL write it, joblib too; nothing in it is run
      (`smpl_pickle`).
    - .pkl and .json of trackers, of several people or frame by frame: see `people`.
    - .bvh: any rig that `rigs` knows.

    Without a frame rate it is `DEFAULT_FPS`. Raises FileError where there is no such file, or it
    holds objects, NaN or other data, and ValueError for another `up`.
    """
    path = Path(path)
    if not path.exists():
        raise FileError(path, "does not exist", "check the path")
    if path.is_dir():
        raise FileError(path, "is a folder", "give the file in it")
    if up not in UP_AXES:
        raise ValueError(f"the axis {up!r} cannot be up: give one of {_listed(list(UP_AXES[1:]))}")
    suffix = path.suffix.lower()
    if suffix in (".pt", ".pth"):
        raise FileError(path, "is a file of PyTorch, which poses are not read from", "save its arrays as .npz")
    if suffix not in ENDINGS:
        raise FileError(path, "is not a pose file", f"give a {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]} file")
    axes, expected = np.eye(3), ""
    try:
        if suffix == ".bvh":
            (motion, axes), expected = read_bvh(path), "y"
        elif suffix in _TREES:
            arrays, lengths = _arrays_of(path, _TREES[suffix](path), person)
            motion = motion_from_arrays(arrays, path)
            if lengths:
                detected = dataclasses.replace(motion.detected, people=tuple(lengths))
                motion = dataclasses.replace(motion, detected=detected)
                expected = "y"
        else:
            arrays = _read_npz(path) if suffix == ".npz" else {"pose": read_npy(path)}
            motion = motion_from_arrays(arrays, path)
            expected = "z" if "trans" in arrays and ("poses" in arrays or "pose_body" in arrays) else ""
    except OSError as e:
        raise FileError(path, f"cannot be read ({e.strerror or e})", "check that it may be opened") from e
    if up:
        return _turned(motion, axes @ axis_direction(up), up)
    return _upright(motion, axes, expected) if expected else motion


def motion_from_arrays(arrays: Mapping[str, NDArray], path: Path) -> Motion:
    """The motion of a file's arrays, named as in `POSE_KEYS`, axes unchanged.

    Raises FileError, also where they hold no poses, and OSError.
    """
    name = str(path)
    check_motion_size(path, max((array.size for array in arrays.values()), default=0))
    if not _holds_smpl(arrays):
        raise FileError(name, "holds no poses", "give 'pose', or 'global_orient' and 'body_pose'")
    check_numbers(arrays, name)
    rest, poses = first_of(arrays, _REST), first_of(arrays, _POSES)
    if rest is None:
        assert poses is not None
        given = _matrices(poses, name)
        rotations, joints = _rotations(given, name), given.shape[1]
    else:
        given = _matrices(rest, name, joints_before=1)
        rotations, joints = _rotations(given, name, joints_before=1), given.shape[1] + 1
        root = first_of(arrays, _ROOT)
        if root is not None:
            if root.ndim == 3 and root.shape[1:] == (3, 3):
                root = root[:, None]  # a matrix a frame
            first = _matrices(root, name)[:, 0]
            if len(first) not in (1, len(rotations)):
                reason = f"holds {len(first)} frames of global_orient but {len(rotations)} of body_pose"
                raise FileError(name, reason, "save as many of each")
            rotations[:, 0] = first
    frames = len(rotations)
    translations = first_of(arrays, _TRANSLATIONS)
    translations = np.zeros((frames, 3)) if translations is None else np.asarray(translations, np.float64)
    if translations.size not in (3, 3 * frames):
        reason = f"holds {frames} frames of poses but translations of shape {translations.shape}"
        raise FileError(name, reason, "save a translation for each frame")
    translations = np.array(np.broadcast_to(translations.reshape(-1, 3), (frames, 3)))
    stated = stated_rate(arrays, name)
    detected = Detected(rig=_BODIES.get(joints, f"{joints} joints"), up="y", fps=stated)
    return Motion(rotations, translations, stated or DEFAULT_FPS, Path(name).stem, detected)


def _holds_smpl(arrays: Mapping[str, NDArray]) -> bool:
    return any(key in arrays for key in _HOLDING)


def _read_npz(path: Path) -> dict[str, NDArray]:
    names = array_names(path)
    arrays = read_arrays(path, optional=POSE_KEYS)
    if not _holds_smpl(arrays):
        if "smpl" in names:
            raise FileError(path, "holds pickled objects, which are never read", "use the version with plain arrays")
        remedy = "give a file with 'poses', or with 'global_orient' and 'body_pose'"
        raise FileError(path, f"holds no poses but {_listed(names)}", remedy)
    return arrays


def _read_json(path: Path) -> Any:
    try:
        return read_json(path)
    except (ValueError, OSError) as e:
        raise FileError(path, f"is not JSON that can be read ({e!s:.120})", "export it again") from e


def _read_pickle(path: Path) -> Any:
    content = load_restricted(read_regular(path, LARGEST_PICKLE), path)
    if not isinstance(content, dict | list):
        reason = f"is not a pickled dictionary of poses (it contains a {type(content).__name__})"
        raise FileError(path, reason, "save it as .npz")
    return content


_TREES: dict[str, Callable[[Path], Any]] = {".json": _read_json, ".pkl": _read_pickle}


def _arrays_of(path: Path, content: Any, person: str) -> tuple[dict[str, NDArray], dict[str, int]]:
    """The arrays of the person in a file's lists and dictionaries, and the frames of each; none without a level above.

    Raises FileError.
    """
    try:
        people = people_in(content, _HOLDING)
        found = {name: _arrays(own, str(path)) for name, own in people.items()}
    except (ValueError, TypeError) as e:
        raise FileError(path, f"is not a file of poses ({e!s:.160})", "save it as .npz") from e
    if not found:
        return _arrays(content, str(path)), {}
    lengths = {name: _length(arrays) for name, arrays in found.items()}
    chosen = choose(found, lengths, person, path)
    return found[chosen], {} if chosen == "" else lengths


def _length(arrays: Mapping[str, NDArray]) -> int:
    values = first_of(arrays, _HOLDING)
    assert values is not None
    return len(values) if values.ndim > 1 and not (values.ndim == 3 and values.shape[1:] == (3, 3)) else 1


def _arrays(content: Any, name: str) -> dict[str, NDArray]:
    """The arrays of a mapping, or of poses alone."""
    if not isinstance(content, Mapping):
        content = {"pose": content}
    try:
        return {
            key: as_array(content[key]) if isinstance(content[key], Stored) else np.asarray(content[key])
            for key in POSE_KEYS
            if key in content
        }
    except (ValueError, TypeError, OverflowError) as e:
        raise FileError(name, f"holds no lists of numbers of equal length ({e!s:.80})", "export it again") from e


def _upright(motion: Motion, axes: NDArray, expected: str) -> Motion:
    """The motion with its detected up axis turned to y; `axes` is the rotation from the file's axes so far."""
    few = motion.frames(np.unique(np.linspace(0, len(motion) - 1, min(len(motion), _MOST_TRIED)).astype(int)))
    up = find_up(few.joints(), expected)
    if up:
        return _turned(motion, axis_direction(up), axis_name(axes.T @ axis_direction(up)))
    up = axis_direction(pelvis_up(few.rotations[:, 0]))
    lying = _turned(motion, up, axis_name(axes.T @ up))
    doubt = "The person stands in no frame, whichever axis is up: set the up axis by hand if it is another one"
    return dataclasses.replace(lying, detected=dataclasses.replace(lying.detected, doubt=doubt))


def _turned(motion: Motion, up: NDArray, in_file: str) -> Motion:
    rotations, translations = turn_y_up(motion.rotations, motion.translations, up)
    return dataclasses.replace(
        motion,
        rotations=rotations,
        translations=translations,
        detected=dataclasses.replace(motion.detected, up=in_file),
    )


def _rotations(given: NDArray, name: str, joints_before: int = 0) -> NDArray[np.float64]:
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
        remedy = "give SMPL's 24 joints, 22 without hands, or those of SMPL-H or SMPL-X"
        raise FileError(name, f"holds poses of {count} joints (shape {given.shape})", remedy)
    rotations = np.tile(np.eye(3), (len(given), 24, 1, 1))
    rotations[:, joints_before:taken] = given[:, : taken - joints_before]
    return rotations


def _matrices(values: NDArray, name: str, joints_before: int = 0) -> NDArray[np.float64]:
    """Rotation matrices [F, n, 3, 3] of axis-angle numbers [3 n], [F, 3 n], [F, n, 3], or of matrices [F, n, 3, 3]."""
    values = np.asarray(values, np.float64)
    if values.ndim in (3, 4) and values.shape[-2:] == (3, 3):
        given = values if values.ndim == 4 else values[None]
        improper = first_improper(given)
        if improper is not None:
            text = improper_text(improper[0], improper[1] + joints_before)
            raise FileError(name, f"holds {text}", "export the poses again")
        return nearest(given)
    if values.ndim == 1:
        values = values[None]
    if values.ndim == 2 and values.shape[1] == 3 and values.shape[0] in (_BODY_JOINTS, 23, 24, 52, 55):
        values = values.reshape(1, -1)  # one pose, a row a joint
    if values.ndim not in (2, 3) or values.shape[-1] % 3 or (values.ndim == 3 and values.shape[-1] != 3):
        remedy = "give 72 axis-angle numbers a frame (24 joints x 3)"
        raise FileError(name, f"holds poses of shape {values.shape}", remedy)
    return from_axis_angle(values.reshape(len(values), -1, 3))


def _listed(names: list[str]) -> str:
    return ", ".join(f"{name[:16]!r}" for name in names[:8]) or "nothing"


def write_amass(path: Path, motion: Motion, betas: NDArray, pelvis: NDArray = REST_JOINTS[0]) -> None:
    """Write a motion in AMASS' format (72 numbers a frame, z up), with the body's shape [n] and rest pelvis [3].

    As in AMASS, `trans` moves the body after its root has turned about the rest pelvis of its y-up body, so
    pelvis + trans is the position of the pelvis. The file appears whole or not at all. Raises OSError.
    """
    up = about_axis(0, np.pi / 2)
    turned = np.array(motion.rotations)
    turned[:, 0] = up @ turned[:, 0]
    places = (motion.translations + pelvis) @ up.T - pelvis
    try:
        os.stat(path.parent)  # a folder that is missing is a slip of the finger: `replacing` would make it
        with atomic_replace(path) as partial, partial.open("wb") as stream:
            np.savez(
                stream,
                poses=to_axis_angle(turned).reshape(len(turned), -1),
                trans=places,
                betas=np.asarray(betas, np.float64),
                gender=np.array("neutral"),
                mocap_framerate=np.array(motion.fps),
            )
    except OSError as error:
        raise OSError(f"the motion could not be written to {str(path)!r} ({error.strerror or error})") from error


WORLD = "smpl_params_global"
_NUMBERS, _PARAMETERS = "tid", "smpl"
MOST = 1000
"""People in a file."""


def people_in(content: Any, keys: Collection[str]) -> dict[str, Mapping[str, Any]]:
    """Arrays by their names of each person, by name; the only person of a file without a level above is called "".

    A person's arrays have one of the `keys`. Other content holds no person. Raises ValueError for frames that do not
    belong together.
    """
    if isinstance(content, list) and content and isinstance(content[0], Mapping):
        content = dict(enumerate(content)) if len(content) > 1 else content[0]
    if not isinstance(content, Mapping):
        return {}
    if any(key in content for key in keys):
        return {"": content}
    if WORLD in content:
        content = {WORLD: content[WORLD]}
    if content and all(isinstance(v, Mapping) and {_NUMBERS, _PARAMETERS} <= v.keys() for v in content.values()):
        return _of_frames(content)
    found = {
        _name(name): person
        for name, person in content.items()
        if isinstance(person, Mapping) and any(key in person for key in keys)
    }
    if len(found) > MOST:
        raise ValueError(f"it holds more than {MOST} people")
    return found


def choose(people: Mapping[str, Mapping[str, np.ndarray]], lengths: Mapping[str, int], name: str, path: Path) -> str:
    """The person called `name`, or who has the most frames where it is empty. Raises FileError."""
    if not name:
        return max(people, key=lambda person: lengths[person])
    if name not in people:
        raise FileError(path, f"has no person {name!r:.40}", f"choose one of {listed(lengths)}")
    return name


def listed(lengths: Mapping[str, int]) -> str:
    """Names and numbers of frames of the people with the most."""
    most = sorted(lengths, key=lambda person: -lengths[person])[:6]
    more = f" and {len(lengths) - len(most)} more" if len(lengths) > len(most) else ""
    return ", ".join(f"{name:.20} ({lengths[name]} frames)" for name in most) + more


def _of_frames(content: Mapping[Any, Any]) -> dict[str, Mapping[str, Any]]:
    """The arrays of the people in frames, those of a person over all frames in which the person is."""
    frames: dict[str, list[Mapping[str, Any]]] = {}
    for frame in content.values():
        numbers, parameters = frame[_NUMBERS], frame[_PARAMETERS]
        if not isinstance(numbers, list) or not isinstance(parameters, list) or len(numbers) != len(parameters):
            raise ValueError(f"a frame has other numbers of people in {_NUMBERS!r} than in {_PARAMETERS!r}")
        for number, own in zip(numbers, parameters, strict=True):
            if not isinstance(own, Mapping) or not {"global_orient", "body_pose"} <= own.keys():
                raise ValueError(f"a frame has no poses in {_PARAMETERS!r}")
            if len(frames) >= MOST and _name(number) not in frames:
                raise ValueError(f"it holds more than {MOST} people")
            frames.setdefault(_name(number), []).append(own)
    return {
        name: {
            key: np.stack([as_array(one[key]).reshape(-1, 3, 3) for one in own])
            for key in ("global_orient", "body_pose")
        }
        for name, own in frames.items()
    }


def _name(key: Any) -> str:
    text = str(as_array(key)) if isinstance(key, Stored) else str(key)
    return "".join(letter for letter in text[:40] if letter.isprintable())
