"""AMASS files, written for tests, and the feet of whoever moves by them."""

import numpy as np
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.rotation import about_axis, to_axis_angle
from blender_primdiffusion.formats.poses.skeleton import joint_positions

from blender_primdiffusion.motion.poses import current_pose, rest_joints


def write_amass(path, frames=31, fps=120.0, **changes):
    """A z-up motion that walks along x, two metres from where people stand."""
    rng = np.random.default_rng(1)
    theta = np.zeros((frames, 52, 3))
    theta[:, 1:22] = rng.normal(0, 0.2, (1, 21, 3)) * np.linspace(0, 1, frames)[:, None, None]
    theta[:, 0] = to_axis_angle(about_axis(0, np.pi / 2))
    trans = np.stack([np.linspace(2, 3, frames), np.full(frames, 5.0), np.full(frames, 1.2)], -1)
    arrays = {"poses": theta.reshape(frames, -1), "trans": trans, "betas": np.zeros(16), "mocap_framerate": fps}
    np.savez(path, **{**arrays, **changes})
    return str(path)


def feet(armature) -> np.ndarray:
    """Heights of ankles and feet over where they are at rest."""
    rotations, translation = current_pose(armature)
    rest = rest_joints(armature)
    chosen = [JOINT_NAMES.index(f"{s}_{p}") for s in ("left", "right") for p in ("ankle", "foot")]
    return joint_positions(rotations, translation, rest)[chosen, 1] - rest[chosen, 1]
