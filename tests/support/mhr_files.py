"""SMPL's motion as SAM 3D Body would return it of MHR, whose joints have rest orientations of their own."""

import json
import pickle
from pathlib import Path

import numpy as np
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.formats.poses.mhr import JOINTS, REST, Y_UP
from primdiffusion.formats.poses.rigs import map_bones, rig_from_smpl
from primdiffusion.formats.poses.rotation import from_axis_angle
from primdiffusion.formats.poses.skeleton import REST_JOINTS, chain

LENGTHS = {
    "l_upleg": (0.08, -0.02, 0.01), "l_lowleg": (0.42, 0, 0), "l_foot": (0.42, 0, 0), "l_subtalar": (0.03, -0.01, 0),
    "l_transversetarsal": (-0.06, 0, 0), "l_ball": (-0.07, -0.04, 0), "l_clavicle": (0.05, 0.1, 0.03),
    "l_uparm": (0.18, 0, 0), "l_lowarm": (0.26, 0, 0), "l_wrist_twist": (0.27, 0, 0), "l_middle1": (0.08, 0, 0),
    "c_spine0": (0, 0.02, -0.03), "c_spine1": (0.11, 0, 0), "c_spine2": (0.11, 0, 0), "c_spine3": (0.18, 0, 0),
    "c_neck": (0.09, 0.05, 0), "c_head": (0.1, 0, 0),
}  # fmt: skip
"""Places of joints in the axes of their parents, metres; roughly MHR's."""


def _offset(name: str) -> np.ndarray:
    left = np.array(LENGTHS.get(name.replace("r_", "l_", 1), (0.0, 0, 0)))
    if not name.startswith("r_"):
        return left
    parent = REST[name][0]
    return left * ([-1, 1, 1] if parent == "root" else [-1, -1, -1] if parent.startswith("r_") else [1, 1, -1])


def places_of(turns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Places [..., 3] of joints whose orientations are `turns` [..., 3, 3]."""
    places = {}
    for name, (parent, _) in REST.items():
        places[name] = places[parent] + turns[parent] @ _offset(name) if parent else turns[name][..., 0] * 0.0
    return places


def mhr_arrays(axis_angle: np.ndarray, moves: np.ndarray) -> dict[str, np.ndarray]:
    """SAM 3D Body's arrays of poses [F, 24, 3] and translations [F, 3] of SMPL."""
    rest = places_of({name: turn for name, (_, turn) in REST.items()})
    bones = map_bones(REST)
    heads, tips = ({j: rest[bone] for j, bone in some.items()} for some in (bones.joints, bones.tips))
    world = chain(from_axis_angle(axis_angle)) @ np.swapaxes(rig_from_smpl(heads, tips), -1, -2)
    own = {bone: world[:, JOINT_NAMES.index(joint)] for joint, bone in bones.joints.items()}
    turns: dict[str, np.ndarray] = {}
    for name, (parent, turn) in REST.items():
        if name not in own:
            own[name] = own[parent]
        turns[name] = own[name] @ turn
    places = places_of(turns)
    rotations, coordinates = np.tile(np.eye(3), (len(world), len(JOINTS), 1, 1)), np.zeros((len(world), len(JOINTS), 3))
    for name in REST:
        rotations[:, JOINTS.index(name)] = turns[name]
        coordinates[:, JOINTS.index(name)] = places[name] * Y_UP
    return {
        "pred_global_rots": rotations.astype(np.float32),
        "pred_joint_coords": coordinates.astype(np.float32),
        "pred_cam_t": ((moves + REST_JOINTS[0]) * Y_UP).astype(np.float32),
        "mhr_model_params": np.zeros((len(world), 204), np.float32),
    }


def write_mhr(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    """Write arrays as .npz, .json or .pkl; the latter two as the list of humans of a picture."""
    if path.suffix == ".npz":
        np.savez(path, **arrays)  # pyright: ignore[reportArgumentType]
    elif path.suffix == ".json":
        path.write_text(json.dumps([{key: array.tolist() for key, array in arrays.items()}]), encoding="utf-8")
    else:
        path.write_bytes(pickle.dumps([arrays]))
    return path
