"""Motion that Kimodo generates (.npz), as motion of SMPL's skeleton.

- `global_rot_mats` [F, J, 3, 3]: orientations of the joints in the world, y up, which are the identity in the T pose;
- `posed_joints` [F, J, 3]: places of the joints, metres;
- J is 77 or 30 for the skeleton SOMA, in the orders `JOINTS`; or 22 for that of SMPL-X, whose `local_rot_mats`
  [F, 22, 3, 3] are SMPL's rotations.

Names, order and axes are those of the documentation of nv-tlabs/kimodo; no file that it wrote has been compared.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...files.regular_files import FileError
from .mhr import frames_of, places_at_rest
from .motion import DEFAULT_FPS, NO_RATE, RATES, Detected, Motion, check_numbers, stated_rate
from .rigs import map_bones, retarget
from .rotation import first_improper, improper_text, nearest
from .skeleton import REST_JOINTS

ROTATIONS, LOCAL, PLACES = "global_rot_mats", "local_rot_mats", "posed_joints"
KEYS = (ROTATIONS, LOCAL, PLACES, *RATES)
"""Names of arrays."""
_SMPL_JOINTS = 22


def _arm(side: str, ends_only: bool) -> str:
    fingers = [f"{side}Hand{finger}End" for finger in ("Thumb", "Middle")]
    if not ends_only:
        fingers = [
            f"{side}Hand{finger}{knuckle}"
            for finger, knuckles in (("Thumb", 3), ("Index", 4), ("Middle", 4), ("Ring", 4), ("Pinky", 4))
            for knuckle in (*range(1, knuckles + 1), "End")
        ]
    return f"{side}Shoulder {side}Arm {side}ForeArm {side}Hand {' '.join(fingers)}"


def _leg(side: str, end: str) -> str:
    return f"{side}Leg {side}Shin {side}Foot {side}ToeBase {end}"


_TRUNK = "Hips Spine1 Spine2 Chest Neck1 Neck2 Head"
JOINTS: dict[int, tuple[str, ...]] = {
    77: tuple(
        f"{_TRUNK} HeadEnd Jaw LeftEye RightEye {_arm('Left', False)} {_arm('Right', False)} "
        f"{_leg('Left', 'LeftToeEnd')} {_leg('Right', 'RightToeEnd')}".split()
    ),
    30: tuple(
        f"{_TRUNK} Jaw LeftEye RightEye {_arm('Left', True)} {_arm('Right', True)} {_leg('Left', '')} "
        f"{_leg('Right', '')}".split()
    ),
}
"""SOMA's joints by their number, in their order."""
_CHAINS = (
    _TRUNK,
    *(
        chain
        for side in ("Left", "Right")
        for chain in (
            f"Chest {side}Shoulder {side}Arm {side}ForeArm {side}Hand {side}HandMiddleEnd",
            f"Hips {side}Leg {side}Shin {side}Foot {side}ToeBase",
        )
    ),
)
REST: dict[str, tuple[str, NDArray[np.float64]]] = {"Hips": ("", np.eye(3))} | {
    joint: (parent, np.eye(3))
    for chain in _CHAINS
    for parent, joint in zip(chain.split(), chain.split()[1:], strict=False)
}
"""Joint -> its parent and its orientation at rest, of the joints that SMPL has, parents first."""


def holds_some(arrays: Mapping[str, NDArray]) -> bool:
    """Whether arrays are those of Kimodo."""
    return ROTATIONS in arrays or LOCAL in arrays


def motion_of(arrays: Mapping[str, NDArray], path: Path) -> Motion:
    """The motion of arrays with Kimodo's names on SMPL's skeleton, y up. Raises FileError, which names `path`."""
    missing = [key for key in (ROTATIONS, LOCAL, PLACES) if key not in arrays]
    if missing:
        raise FileError(path, f"holds Kimodo's motion without {missing[0]!r}", "save all that Kimodo returns")
    check_numbers(arrays, str(path))
    count = arrays[ROTATIONS].shape[-3] if arrays[ROTATIONS].ndim >= 3 else 0
    if count not in (*JOINTS, _SMPL_JOINTS):
        shape = f"holds {ROTATIONS} of shape {arrays[ROTATIONS].shape}"
        raise FileError(
            path, shape, f"save the {', '.join(map(str, JOINTS))} joints of SOMA, or SMPL-X' {_SMPL_JOINTS}"
        )
    turns, local = (frames_of(arrays[key], (count, 3, 3), key, path) for key in (ROTATIONS, LOCAL))
    places = frames_of(arrays[PLACES], (count, 3), PLACES, path)
    if not len(turns) == len(local) == len(places):
        raise FileError(path, f"has {len(turns)} frames of {ROTATIONS} but {len(places)} of {PLACES}", "save it again")
    improper = first_improper(local if count == _SMPL_JOINTS else turns)
    if improper is not None:
        raise FileError(path, f"holds {improper_text(*improper)}", "export the motion again")
    stated = stated_rate(arrays, str(path))
    notes = (NO_RATE,) if not stated and len(turns) > 1 else ()
    if count == _SMPL_JOINTS:
        rotations = np.tile(np.eye(3), (len(local), 24, 1, 1))
        rotations[:, :_SMPL_JOINTS] = nearest(local)
        detected, pelvis = Detected("SMPL-X", "y", fps=stated), places[:, 0]
    else:
        world = {name: nearest(turns[:, JOINTS[count].index(name)]) for name in REST}
        at = {name: places[:, JOINTS[count].index(name)] for name in REST}
        bones = map_bones(REST)
        try:
            rest = places_at_rest(REST, world, at)
            rotations, from_file = retarget(bones, rest, {bone: world[bone] for bone in bones.joints.values()})
        except ValueError as e:
            raise FileError(path, f"has joints of no human ({e})", "export the motion again") from e
        detected, pelvis = Detected(bones.rig, "y", fps=stated, bones=bones.joints), at["Hips"] @ from_file.T
    return Motion(rotations, pelvis - REST_JOINTS[0], stated or DEFAULT_FPS, path.stem, notes, detected)
