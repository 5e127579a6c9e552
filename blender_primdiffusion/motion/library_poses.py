"""The poses of the pose library, as angles of limbs in degrees; those that captures use too are taken from there."""

from __future__ import annotations

from .poses import BUILT_IN, Arm, Leg, Pose

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
"""Poses by the names that people see."""
