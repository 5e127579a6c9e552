"""Poses of the Momentum Human Rig (MHR), as SAM 3D Body estimates them, as motion of SMPL's skeleton.

What SAM 3D Body returns for one human (`process_one_image`), saved as .npz, JSON or .pkl under its own names:

- `pred_global_rots` [127, 3, 3] or [F, 127, 3, 3]: orientations of the joints in the world, y up;
- `pred_joint_coords` [127, 3] or [F, 127, 3]: places of the joints in metres, in a camera's axes (y down, z away);
- `pred_cam_t` [3] or [F, 3]: added to the places, where it is there;
- `joint_names` [n], which SAM 3D Body does not write: the order of the joints, where it is not MHR's.

Angles (`body_pose_params`, `mhr_model_params`) are not read: only MHR itself turns them into joints. The fields, their
axes and the order of the joints are those of the sources of facebookresearch/sam-3d-body and MHR 1.0; they have not
been compared with a file that the released model wrote.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...files.regular_files import FileError
from .motion import DEFAULT_FPS, RATES, Detected, Motion, check_numbers, stated_rate
from .rigs import map_bones, retarget
from .rotation import first_improper, from_axis_angle, improper_text, nearest
from .skeleton import REST_JOINTS

ROTATIONS, PLACES, CAMERA, NAMES = "pred_global_rots", "pred_joint_coords", "pred_cam_t", "joint_names"
_ANGLES = ("mhr_model_params", "body_pose_params")
POSES = (ROTATIONS, PLACES, *_ANGLES)
"""Names of arrays, of which a file of MHR has some."""
KEYS = (*POSES, CAMERA, NAMES, *RATES)
"""Names of all arrays that are read."""
Y_UP = np.array([1.0, -1.0, -1.0])
"""Times a place in a camera's axes: y up, facing the camera."""


def _fingers(side: str) -> str:
    fingers = " ".join(
        f"{side}_{finger}{knuckle}"
        for finger, first in (("pinky", 0), ("ring", 1), ("middle", 1), ("index", 1), ("thumb", 0))
        for knuckle in (*range(first, 4), "_null")
    )
    return f"{side}_clavicle {side}_uparm {side}_lowarm {side}_wrist_twist {side}_wrist {fingers} " + " ".join(
        [f"{side}_lowarm_twist{number}_proc" for number in range(1, 5)]
        + [f"{side}_uparm_twist{number}_proc" for number in range(5)]
    )


def _leg(side: str) -> str:
    bones = ("upleg", "lowleg", "foot", "talocrural", "subtalar", "transversetarsal", "ball")
    return " ".join(
        [f"{side}_{bone}" for bone in bones]
        + [f"{side}_lowleg_twist{number}_proc" for number in range(1, 5)]
        + [f"{side}_upleg_twist{number}_proc" for number in range(5)]
    )


JOINTS: tuple[str, ...] = tuple(
    f"body_world root {_leg('l')} {_leg('r')} c_spine0 c_spine1 c_spine2 c_spine3 {_fingers('r')} {_fingers('l')} "
    "c_neck c_neck_twist1_proc c_neck_twist0_proc c_head c_jaw c_teeth c_jaw_null c_tongue0 c_tongue1 c_tongue2 "
    "c_tongue3 c_tongue4 r_eye r_eye_null l_eye l_eye_null c_head_null".split()
)
"""MHR's 127 joints in their order."""
_MIDDLE = {
    "root": ("", (0.0, 0.0, 0.0)), "c_spine0": ("root", (1.1798, 1.2278, 1.1798)),
    "c_spine1": ("c_spine0", (1.1798, 1.2278, 1.1798)), "c_spine2": ("c_spine1", (1.1798, 1.2278, 1.1798)),
    "c_spine3": ("c_spine2", (1.1798, 1.2278, 1.1798)), "c_neck": ("c_spine3", (1.4213, 1.0564, 1.4213)),
    "c_head": ("c_neck", (1.2092, 1.2092, 1.2092)),
}  # fmt: skip
_LEFT = {
    "l_upleg": ("root", (-1.2254, 1.1719, -1.0551)), "l_lowleg": ("l_upleg", (-1.2055, 1.1883, -1.0384)),
    "l_foot": ("l_lowleg", (-1.2055, 1.1883, -1.0384)), "l_talocrural": ("l_foot", (-1.2055, 1.1883, -1.0384)),
    "l_subtalar": ("l_talocrural", (-0.1367, 1.5776, -0.1352)),
    "l_transversetarsal": ("l_subtalar", (-0.1367, 1.5776, -0.1352)),
    "l_ball": ("l_transversetarsal", (0.0157, 1.8023, -0.0125)), "l_clavicle": ("c_spine3", (1.5489, 0.5115, -0.3928)),
    "l_uparm": ("l_clavicle", (1.0162, -0.5055, -0.7155)), "l_lowarm": ("l_uparm", (0.8019, -0.7808, -0.1858)),
    "l_wrist_twist": ("l_lowarm", (2.6022, -0.9166, 0.8147)), "l_wrist": ("l_wrist_twist", (2.6022, -0.9166, 0.8147)),
    "l_middle1": ("l_wrist", (2.6204, -1.0904, 0.6993)),
}  # fmt: skip
_MIRROR = np.diag([-1.0, 1.0, 1.0])


def _rest() -> dict[str, tuple[str, NDArray[np.float64]]]:
    found = {name: (parent, from_axis_angle(np.array(turn))) for name, (parent, turn) in (_MIDDLE | _LEFT).items()}
    for name in _LEFT:
        parent, turn = found[name]
        found[name.replace("l_", "r_", 1)] = (parent.replace("l_", "r_", 1), -_MIRROR @ turn)
    return found


REST: dict[str, tuple[str, NDArray[np.float64]]] = _rest()
"""Joint -> its parent and its orientation [3, 3] at rest: arms 45 degrees down, y up, facing +z.

Only those between the pelvis and SMPL's joints. A right joint is its left one mirrored, its axes reversed. Taken from
an extraction that others published of MHR's rig (Meta, Apache-2.0): bones lie along their first axis, and both sides
mirror each other within 1e-4. Any pose of the rig could stand here, since places at rest are derived from it.
"""
_TURNS = {f"{side}_foot": f"{side}_transversetarsal" for side in "lr"}
"""The ankle has its place at one joint; the foot turns with the last of the joints behind it."""


def holds_some(arrays: Mapping[str, NDArray]) -> bool:
    """Whether arrays are those of SAM 3D Body, all or some."""
    return any(key in arrays for key in POSES)


def motion_of(arrays: Mapping[str, NDArray], path: Path) -> Motion:
    """The motion of arrays with SAM 3D Body's names on SMPL's skeleton, y up.

    Body parts turn as MHR's do, from its rest pose (`rigs.retarget`). Lengths at rest are those of the file. Fingers,
    face and the joints of the torso and the feet that SMPL lacks are left out. Raises FileError, which names
    `path`.
    """
    if ROTATIONS not in arrays or PLACES not in arrays:
        has = f"holds {', '.join(sorted(set(arrays) & set(KEYS)))} of MHR but not both {ROTATIONS} and {PLACES}"
        raise FileError(path, has, "save both as SAM 3D Body returns them")
    names = _names(arrays.get(NAMES), path)
    numbers = {key: array for key, array in arrays.items() if key in (ROTATIONS, PLACES, CAMERA, *RATES)}
    check_numbers(numbers, str(path))
    turns = _frames_of(arrays[ROTATIONS], (len(names), 3, 3), ROTATIONS, path)
    places = _frames_of(arrays[PLACES], (len(names), 3), PLACES, path)
    camera = _frames_of(arrays.get(CAMERA, np.zeros(3)), (3,), CAMERA, path)
    if len(places) != len(turns) or len(camera) not in (1, len(turns)):
        raise FileError(
            path,
            f"has {len(turns)} frames of {ROTATIONS}, {len(places)} of {PLACES} and {len(camera)} of {CAMERA}",
            "save as many of each",
        )
    index = {name: names.index(name) for name in REST}
    turns = turns[:, list(index.values())]
    improper = first_improper(turns)
    if improper is not None:
        text = improper_text(improper[0], list(index)[improper[1]])
        raise FileError(path, f"holds {text}", "export the poses again")
    world = dict(zip(index, np.moveaxis(nearest(turns), 1, 0), strict=True))
    at = {name: places[:, number] * Y_UP for name, number in index.items()}
    bones = map_bones(REST)
    turned = {bone: world[_TURNS.get(bone, bone)] @ REST[_TURNS.get(bone, bone)][1].T for bone in bones.joints.values()}
    try:
        rotations, from_file = retarget(bones, _places_at_rest(REST, world, at), turned)
    except ValueError as e:
        raise FileError(path, f"has joints of no human ({e})", "save the poses again") from e
    pelvis = (at["root"] + camera * Y_UP) @ from_file.T
    stated = stated_rate(arrays, str(path))
    detected = Detected(bones.rig, "y", fps=stated, bones=bones.joints)
    return Motion(rotations, pelvis - REST_JOINTS[0], stated or DEFAULT_FPS, path.stem, detected)


def _names(given: NDArray | None, path: Path) -> list[str]:
    """The names of the joints in the file's order, all of `REST` among them."""
    if given is None:
        return list(JOINTS)
    if given.ndim != 1 or given.dtype.kind != "U":
        raise FileError(path, f"has {NAMES} of {given.dtype} {given.shape}", "give a list of names, one a joint")
    names = [str(name) for name in given]
    missing = [name for name in REST if names.count(name) != 1]
    if missing:
        raise FileError(path, f"lacks the joint {missing[0]!r} of MHR, or names it twice", "save all of its joints")
    return names


def _frames_of(values: NDArray, shape: tuple[int, ...], key: str, path: Path) -> NDArray[np.float64]:
    """Numbers of one frame or many as those of many [F, *shape]."""
    values = values if values.ndim > len(shape) else values[None]
    if values.shape[1:] != shape:
        wanted = f"{key} of shape {values.shape} instead of [F, {', '.join(map(str, shape))}]"
        raise FileError(path, f"has {wanted}", "save all joints of the rig, in its own order")
    return np.asarray(values, np.float64)


def _places_at_rest(
    rest: Mapping[str, tuple[str, NDArray]], world: Mapping[str, NDArray], at: Mapping[str, NDArray]
) -> dict[str, NDArray[np.float64]]:
    """Places of joints [3] at rest: each is fixed to its parent, on average over the frames.

    `rest` are the joints' parents and orientations at rest, parents first; `world` and `at` their orientations
    [F, 3, 3] and places [F, 3].
    """
    places: dict[str, NDArray[np.float64]] = {}
    for name, (parent, _) in rest.items():
        if not parent:
            places[name] = np.zeros(3)
            continue
        offset = np.einsum("fji,fj->fi", world[parent], at[name] - at[parent]).mean(0)
        places[name] = places[parent] + rest[parent][1] @ offset
    return places
