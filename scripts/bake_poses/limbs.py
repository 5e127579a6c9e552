"""Poses as angles of limbs in degrees."""

from __future__ import annotations

import dataclasses

import numpy as np
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.rotation import about_axis
from numpy.typing import NDArray

X, Y, Z = 0, 1, 2


@dataclasses.dataclass(frozen=True)
class Arm:
    """An arm in degrees relative to the T pose, the same for both sides."""

    down: float = 75.0
    """From level to the side; negative is up."""
    front: float = 0.0
    """About the vertical, then."""
    swing: float = 0.0
    """Forward in the direction of walking, last."""
    twist: float = 0.0
    """About itself, first: positive turns the thumb down."""
    elbow: float = 12.0
    """Bent forward."""
    forearm: float = 0.0
    """Twist of the forearm, as `twist`."""
    wrist: float = 0.0
    """Bent towards the palm."""
    shrug: float = 0.0
    """The shoulder raised."""


@dataclasses.dataclass(frozen=True)
class Leg:
    """A leg in degrees relative to standing, the same for both sides."""

    front: float = 0.0
    """The thigh raised to the front; negative to the back."""
    out: float = 3.0
    """To the side."""
    turn: float = 6.0
    """The toes turned out."""
    knee: float = 4.0
    ankle: float = 0.0
    """The toes raised; negative pointed."""
    toes: float = 0.0
    """Bent up."""


@dataclasses.dataclass(frozen=True)
class Pose:
    """A pose in degrees: arms, legs, and how far the trunk and the head bend forward, turn and lean to the left."""

    left_arm: Arm
    right_arm: Arm
    left_leg: Leg
    right_leg: Leg
    trunk: tuple[float, float, float] = (0.0, 0.0, 0.0)
    head: tuple[float, float, float] = (0.0, 0.0, 0.0)
    whole: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation of the pelvis, and all with it."""

    def rotations(self) -> NDArray[np.float64]:
        """SMPL's joint rotations [24, 3, 3]; [F, 24, 3, 3] where angles are arrays [F]."""
        turned = {"pelvis": _bend(*self.whole)}
        for spine in ("spine1", "spine2", "spine3"):
            turned[spine] = _bend(*(angle / 3 for angle in self.trunk))
        for part in ("neck", "head"):
            turned[part] = _bend(*(angle / 2 for angle in self.head))
        for side, sign, arm, leg in (
            ("left", 1, self.left_arm, self.left_leg),
            ("right", -1, self.right_arm, self.right_leg),
        ):
            turned |= {f"{side}_{part}": turn for part, turn in (_arm(arm, sign) | _leg(leg, sign)).items()}
        joints = [turned.get(name, np.eye(3)) for name in JOINT_NAMES]
        return np.stack(np.broadcast_arrays(*joints), -3)


def _bend(forward: float, left: float, lean: float) -> NDArray[np.float64]:
    return _turn(Y, left) @ _turn(Z, -lean) @ _turn(X, forward)


def _arm(arm: Arm, sign: int) -> dict[str, NDArray[np.float64]]:
    """Along +x for the left arm; a mirrored turn about y or z is the opposite one, about x the same."""
    return {
        "collar": _turn(Z, sign * arm.shrug),
        "shoulder": _turn(X, -arm.swing)
        @ _turn(Y, -sign * arm.front)
        @ _turn(Z, -sign * arm.down)
        @ _turn(X, arm.twist),
        "elbow": _turn(Y, -sign * arm.elbow) @ _turn(X, arm.forearm),
        "wrist": _turn(Z, -sign * arm.wrist),
    }


def _leg(leg: Leg, sign: int) -> dict[str, NDArray[np.float64]]:
    return {
        "hip": _turn(X, -leg.front) @ _turn(Z, sign * leg.out) @ _turn(Y, sign * leg.turn),
        "knee": _turn(X, leg.knee),
        "ankle": _turn(X, -leg.ankle),
        "foot": _turn(X, -leg.toes),
    }


def _turn(axis: int, degrees: float | NDArray) -> NDArray[np.float64]:
    return about_axis(axis, np.radians(degrees))
