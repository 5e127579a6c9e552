"""Write motion as AMASS files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..formats.poses.motion import Motion
from ..formats.poses.rotation import about_axis, to_axis_angle
from ..formats.poses.skeleton import REST_JOINTS
from ..formats.whole_files import replacing


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
        with replacing(path) as partial, partial.open("wb") as stream:
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
