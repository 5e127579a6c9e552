"""Motion written as AMASS keeps it: `poses`, `trans`, `betas`, `mocap_framerate`, z up."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .motion import Motion
from .rotation import about_axis, to_axis_angle
from .skeleton import REST_JOINTS


def write_amass(path: Path, motion: Motion, betas: NDArray, pelvis: NDArray = REST_JOINTS[0]) -> None:
    """Write a motion as SMPL's 72 numbers a frame, with the shape [n] of who moves and their pelvis at rest [3].

    As in AMASS, `trans` moves the body after its root has turned about the rest pelvis of its own y-up body, so
    pelvis + trans is where the pelvis is, z up. The file appears whole or not at all. Raises OSError.
    """
    up = about_axis(0, np.pi / 2)
    turned = np.array(motion.rotations)
    turned[:, 0] = up @ turned[:, 0]
    places = (motion.translations + pelvis) @ up.T - pelvis
    unfinished = path.with_name(f".{path.name}.part")
    try:
        with unfinished.open("wb") as stream:
            np.savez(
                stream,
                poses=to_axis_angle(turned).reshape(len(turned), -1),
                trans=places,
                betas=np.asarray(betas, np.float64),
                gender=np.array("neutral"),
                mocap_framerate=np.array(motion.fps),
            )
        os.replace(unfinished, path)
    except OSError as error:
        unfinished.unlink(missing_ok=True)
        raise OSError(f"the motion could not be written to {str(path)!r} ({error.strerror or error})") from error
