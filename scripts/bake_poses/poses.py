"""The built-in poses of captures, and those of the extension's asset library."""

from __future__ import annotations

from .limbs import Arm, Leg, Pose

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
"""Poses of captures by name; captures begin with the first."""
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
"""Pose assets by name. Those that captures use too are of BUILT_IN."""
