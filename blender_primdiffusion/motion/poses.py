"""Built-in poses, as angles of limbs in degrees, and diverse poses picked from motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..formats.joints import JOINT_NAMES
from ..formats.poses.motion import Motion
from ..formats.poses.rotation import about_axis
from ..formats.poses.skeleton import REST_JOINTS, joint_positions
from .legs import FLOOR

X, Y, Z = 0, 1, 2
_CLEARANCE = REST_JOINTS[:, 1] - FLOOR
_TOUCHING = {"knee": 0.06, "elbow": 0.04, "wrist": 0.03, "hand": 0.03, "pelvis": 0.12, "head": 0.12}
"""Metres from joints to the skin below them; ankles and feet have their rest height."""
_POOL = 1000
"""Number of frames from which poses are picked."""
_NEAR_T_M = 0.08
"""Mean distance of the joints from the first built-in pose up to which a frame counts as near T."""


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


_HANGING = Arm(down=76, elbow=14, forearm=-10)

BUILT_IN: dict[str, Pose] = {
    "near T": Pose(Arm(down=8, elbow=4), Arm(down=8, elbow=4), Leg(out=4), Leg(out=4)),
    "A": Pose(Arm(down=45, elbow=10), Arm(down=45, elbow=10), Leg(out=6), Leg(out=6)),
    "standing": Pose(
        Arm(down=74, elbow=20, swing=4), Arm(down=77, elbow=10, swing=-4),
        Leg(out=7, turn=16, front=6, knee=12, ankle=4), Leg(out=1, turn=4), trunk=(0, 6, -4), head=(4, 10, 3),
        whole=(0, -4, 2),
    ),
    "walking": Pose(
        Arm(down=76, swing=-24, elbow=12), Arm(down=76, swing=22, elbow=28),
        Leg(front=28, knee=6, ankle=10, out=1), Leg(front=-18, knee=24, ankle=-14, toes=22, out=1),
        trunk=(5, -10, 0), head=(0, 6, 0), whole=(2, 4, 0),
    ),
    "striding": Pose(
        Arm(down=74, swing=34, elbow=42), Arm(down=74, swing=-30, elbow=22),
        Leg(front=-22, knee=38, ankle=-18, toes=26, out=1), Leg(front=34, knee=14, ankle=8, out=1),
        trunk=(8, 14, 0), head=(-4, -8, 0), whole=(4, -6, 0),
    ),
    "running": Pose(
        Arm(down=68, swing=-46, elbow=88), Arm(down=70, swing=44, elbow=96),
        Leg(front=66, knee=84, ankle=6, out=1, turn=2), Leg(front=-22, knee=34, ankle=-26, toes=20, out=1, turn=2),
        trunk=(12, -14, 0), head=(-12, 10, 0), whole=(12, 4, 0),
    ),
    "sitting": Pose(
        Arm(down=70, swing=26, elbow=54, twist=34), Arm(down=70, swing=26, elbow=54, twist=34),
        Leg(front=86, knee=88, out=8), Leg(front=86, knee=88, out=8), trunk=(8, 0, 0), head=(2, -12, 0),
    ),
    "arms up": Pose(
        Arm(down=-62, elbow=16, front=14, shrug=16), Arm(down=-62, elbow=16, front=14, shrug=16),
        Leg(out=7), Leg(out=7), trunk=(-6, 0, 0), head=(-14, 0, 0),
    ),
    "arms crossed": Pose(
        Arm(down=68, swing=30, elbow=102, twist=60), Arm(down=68, swing=46, elbow=88, twist=54),
        Leg(out=5, turn=12), Leg(out=5, turn=10), trunk=(2, 4, 0), head=(2, -10, -4),
    ),
    "waving": Pose(
        _HANGING, Arm(down=-8, front=12, elbow=82, twist=-84, shrug=4), Leg(out=5, turn=12), Leg(out=2),
        trunk=(0, -4, 4), head=(0, -10, 5),
    ),
    "pointing": Pose(
        Arm(down=72, elbow=24), Arm(down=4, front=72, elbow=6, shrug=2), Leg(front=-8, knee=8, turn=18, out=5),
        Leg(front=14, knee=12, ankle=2, out=3), trunk=(2, 12, 0), head=(2, -6, 0),
    ),
    "squatting": Pose(
        Arm(down=18, front=74, elbow=20), Arm(down=18, front=74, elbow=20),
        Leg(front=96, knee=104, ankle=22, out=18, turn=22), Leg(front=96, knee=104, ankle=22, out=18, turn=22),
        trunk=(14, 0, 0), head=(-22, 0, 0), whole=(24, 0, 0),
    ),
    "lunging": Pose(
        Arm(down=58, elbow=70, swing=10), Arm(down=62, elbow=60, swing=24),
        Leg(front=74, knee=78, ankle=4, out=3), Leg(front=-28, knee=46, ankle=-10, toes=34, out=3),
        trunk=(4, -6, 0), head=(-4, 0, 0), whole=(4, 0, 0),
    ),
    "looking back": Pose(
        Arm(down=66, elbow=24, swing=14), Arm(down=66, elbow=30, swing=-18), Leg(out=6, turn=14), Leg(out=4, turn=4),
        trunk=(2, 38, 0), head=(0, 46, -4), whole=(0, 14, 0),
    ),
    "dancing": Pose(
        Arm(down=-38, front=10, elbow=52, twist=-50, shrug=12), Arm(down=26, front=-10, elbow=64, twist=40),
        Leg(front=12, knee=38, ankle=-24, out=14, turn=26, toes=12), Leg(front=4, knee=14, out=2, turn=14, ankle=6),
        trunk=(-4, -14, -12), head=(-6, 16, 10), whole=(0, 10, -6),
    ),
    "hands on hips": Pose(
        Arm(down=46, front=-32, elbow=96, twist=54, wrist=10), Arm(down=46, front=-32, elbow=96, twist=54, wrist=10),
        Leg(out=9, turn=10), Leg(out=9, turn=10), trunk=(-2, -6, 0), head=(4, 14, 0),
    ),
    "kicking": Pose(
        Arm(down=28, front=24, elbow=30), Arm(down=42, front=-24, elbow=24),
        Leg(front=-6, knee=16, ankle=8, out=2, turn=18), Leg(front=72, knee=18, ankle=-24, out=6),
        trunk=(8, 10, 0), head=(6, -4, 0), whole=(-12, 0, 0),
    ),
    "stooping": Pose(
        Arm(down=64, swing=46, elbow=10), Arm(down=64, swing=40, elbow=14),
        Leg(front=48, knee=46, ankle=12, out=6), Leg(front=44, knee=44, ankle=12, out=6),
        trunk=(42, 0, 0), head=(-20, 8, 0), whole=(34, 0, 0),
    ),
    "reaching": Pose(
        Arm(down=70, elbow=26, swing=-10), Arm(down=-66, front=30, elbow=8, shrug=20),
        Leg(front=-4, ankle=-18, toes=20, out=3), Leg(front=6, knee=26, ankle=-18, toes=12, out=4),
        trunk=(-4, 10, 10), head=(-26, -14, 0),
    ),
    "on one leg": Pose(
        Arm(down=-4, elbow=14), Arm(down=6, elbow=18), Leg(front=40, knee=96, out=34, turn=40, ankle=-16), Leg(out=-2),
        trunk=(0, 0, -4), head=(0, -6, 2), whole=(0, 0, -2),
    ),
}  # fmt: skip
"""Poses for captures by name; captures begin with the first."""
LIBRARY: dict[str, Pose] = {
    "T": Pose(Arm(down=0, elbow=0), Arm(down=0, elbow=0), Leg(out=0, turn=0, knee=0), Leg(out=0, turn=0, knee=0)),
    "A": BUILT_IN["A"],
    "Relaxed": Pose(
        Arm(down=75, elbow=18, swing=4, forearm=-10), Arm(down=76, elbow=12, swing=0, forearm=-10),
        Leg(out=6, turn=14, front=4, knee=9, ankle=4), Leg(out=-1, turn=4), trunk=(1, 3, -4), head=(3, 8, 3),
        whole=(0, -3, 3),
    ),
    "Contrapposto": BUILT_IN["standing"],
    "Hands on Hips": BUILT_IN["hands on hips"],
    "Arms Crossed": BUILT_IN["arms crossed"],
    "Thinking": Pose(
        Arm(down=70, swing=30, elbow=90, twist=62), Arm(down=70, swing=40, elbow=132, twist=40, wrist=8),
        Leg(out=5, turn=12), Leg(out=4, turn=8), trunk=(3, 4, 0), head=(12, -8, -6),
    ),
    "Waving": BUILT_IN["waving"],
    "Pointing": BUILT_IN["pointing"],
    "Cheering": BUILT_IN["arms up"],
    "Walking": BUILT_IN["walking"],
    "Running": BUILT_IN["running"],
    "Sitting": BUILT_IN["sitting"],
    "Kneeling": Pose(
        Arm(down=68, swing=34, elbow=40, twist=24), Arm(down=75, elbow=16, forearm=-10),
        Leg(front=84, knee=86, ankle=2, out=6), Leg(front=-6, knee=94, ankle=-22, toes=60, out=3),
        trunk=(4, 0, 0), head=(0, 6, 0), whole=(2, 0, 0),
    ),
    "Squatting": BUILT_IN["squatting"],
    "Lunging": BUILT_IN["lunging"],
    "Reaching": BUILT_IN["reaching"],
    "Looking Back": BUILT_IN["looking back"],
    "Dancing": BUILT_IN["dancing"],
    "On One Leg": BUILT_IN["on one leg"],
}  # fmt: skip
"""The pose library: poses by the names in its menu. Those that captures use too are BUILT_IN."""


def built_in_poses(count: int = len(BUILT_IN)) -> Motion:
    """The first `count` built-in poses, feet on the floor. Raises ValueError where there are fewer."""
    if not 1 <= count <= len(BUILT_IN):
        raise ValueError(f"there are 1 to {len(BUILT_IN)} built-in poses, not {count}: give files for more")
    rotations = np.array([pose.rotations() for pose in list(BUILT_IN.values())[:count]])
    return Motion(rotations, grounding(rotations), 1.0, "built-in")


def grounding(rotations: NDArray) -> NDArray[np.float64]:
    """Vertical translations [F, 3] that put the lowest part of the average body on its floor at rest."""
    joints = joint_positions(rotations)
    clearance = np.array(
        [
            _CLEARANCE[joint] if name.split("_")[-1] in ("ankle", "foot") else _TOUCHING.get(name.split("_")[-1], 0.1)
            for joint, name in enumerate(JOINT_NAMES)
        ]
    )
    down = FLOOR - (joints[..., 1] - clearance).min(-1)
    return np.stack([np.zeros_like(down), down, np.zeros_like(down)], -1)


def pick_poses(motions: Sequence[Motion], count: int, seed: int = 0) -> Motion:
    """`count` poses from the frames of all motions, near-T first, the others as different as possible.

    Each next pose is the one farthest from those picked (farthest-point sampling over joint positions about the pelvis,
    regardless of heading). Where no frame is near a T pose, the built-in one is the first. Poses are put on the floor
    at the origin. The same seed picks the same poses.

    Raises ValueError where the motions have too few frames.
    """
    rotations = np.concatenate([motion.rotations for motion in motions]) if motions else np.zeros((0, 24, 3, 3))
    if len(rotations) < count - 1 or count < 1:
        raise ValueError(
            f"{count} poses cannot be picked from {len(rotations)} frames: give more files, or ask for fewer poses"
        )
    first = built_in_poses(1).rotations
    from_t = _distance(_about_pelvis(rotations), _about_pelvis(first)[0])
    has_t = len(rotations) >= count and from_t.min() < _NEAR_T_M
    if has_t:
        first = rotations[[int(from_t.argmin())]]
    if len(rotations) > _POOL:
        chosen = np.random.default_rng(seed).choice(len(rotations), _POOL, replace=False)
        rotations = rotations[np.sort(chosen)]
    rotations = np.concatenate([first, rotations])
    places, picked = _about_pelvis(rotations), [0]
    distance = _distance(places, places[0])
    while len(picked) < count:
        distance[picked] = -1.0
        picked.append(int(distance.argmax()))
        distance = np.minimum(distance, _distance(places, places[picked[-1]]))
    poses = rotations[picked]
    names = ", ".join(dict.fromkeys(motion.name for motion in motions))
    notes = () if has_t else ("no frame is near a T pose: the first is built in",)
    return Motion(poses, grounding(poses), 1.0, names, notes)


def _about_pelvis(rotations: NDArray) -> NDArray[np.float64]:
    """Joints [F, 24, 3] relative to the pelvis, turned about the vertical to face +z."""
    front = rotations[:, 0, :, 2]
    unturned = np.array(rotations)
    unturned[:, 0] = about_axis(Y, -np.arctan2(front[:, 0], front[:, 2])) @ rotations[:, 0]
    return joint_positions(unturned) - REST_JOINTS[0]


def _distance(places: NDArray, place: NDArray) -> NDArray[np.float64]:
    """Mean distance of the joints [F] between poses [F, 24, 3] and one pose [24, 3], metres."""
    return np.linalg.norm(places - place, axis=-1).mean(-1)
