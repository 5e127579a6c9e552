"""Built-in motions: a walk, standing, a wave, a turn to the left."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .motion import Detected, Motion
from .poses import Arm, Leg, Pose
from .rotation import about_axis
from .skeleton import REST_JOINTS, FootTrack, joint, reach
from .walk import CYCLE_SECONDS, walk

_TOES_OUT = np.radians(9.0)
_IDLE_SECONDS, _WAVE_SECONDS, _TURN_SECONDS = 6.0, 3.0, 2.4


@dataclasses.dataclass(frozen=True)
class BuiltIn:
    """A motion that needs no file."""

    label: str
    about: str
    """Description for the menu."""
    seconds: float
    """Duration of one round."""
    loops: bool
    """Whether the end continues into the beginning."""
    make: Callable[[int, float], Motion]
    """Makes the motion from a number of rounds and a frame rate."""


def built_in_motion(name: str, rounds: int, fps: float) -> Motion:
    """One of `MOTIONS`, repeated `rounds` times, for the average skeleton standing on the floor. Raises KeyError."""
    motion = MOTIONS[name].make(rounds, fps)
    return dataclasses.replace(motion, detected=Detected(rig="built in", up="y", average_legs=True))


def idle(rounds: int = 1, fps: float = 30.0) -> Motion:
    """Standing: the weight shifts from leg to leg and back, two breaths; the feet stay."""
    phase = _phase(rounds, _IDLE_SECONDS, fps)
    sway, breath = np.sin(2 * np.pi * phase), np.cos(4 * np.pi * phase)
    return _standing(
        Pose(
            Arm(down=75 + 0.8 * breath, elbow=16, swing=2 + sway, forearm=-10, shrug=-0.6 * breath),
            Arm(down=76 + 0.8 * breath, elbow=13, swing=1 - sway, forearm=-10, shrug=-0.6 * breath),
            Leg(),
            Leg(),
            trunk=(1.0 + 0.9 * breath, 2.0 * sway, 2.5 * sway),
            head=(2.0 - 0.7 * breath, 6.0 * np.sin(2 * np.pi * phase - 0.8), -1.5 * sway),
            whole=(0.0, -1.5 * sway, -1.5 * sway),
        ),
        np.stack([0.028 * sway, -0.016 + 0.001 * breath, np.zeros_like(phase)], -1),
        fps,
        "Idle",
    )


def wave(rounds: int = 1, fps: float = 30.0) -> Motion:
    """Standing; the right hand goes up, waves and comes down."""
    phase = _phase(rounds, _WAVE_SECONDS, fps)
    share = phase - np.floor(np.minimum(phase, rounds - 1e-9))
    up = _ease(share / 0.25) * (1 - _ease((share - 0.75) / 0.25))
    to_and_fro = np.sin(2 * np.pi * 4 * (share - 0.2)) * _ease((share - 0.2) / 0.1) * (1 - _ease((share - 0.7) / 0.1))
    return _standing(
        Pose(
            Arm(down=75, elbow=15, forearm=-10, swing=2 * up),
            Arm(
                down=76 - 84 * up,
                front=12 * up,
                elbow=14 + 66 * up + 15 * to_and_fro * up,
                twist=-84 * up,
                forearm=-10 * (1 - up),
                shrug=4 * up,
            ),
            Leg(),
            Leg(),
            trunk=(1.0, -3 * up, 2.5 * up),
            head=(1 - up, -7 * up, 4 * up + 1.0 * to_and_fro),
            whole=(0.0, 0.0, 0.8 * up),
        ),
        np.stack([0.012 * up, np.full_like(up, -0.014), np.zeros_like(up)], -1),
        fps,
        "Wave",
    )


def turn(rounds: int = 1, fps: float = 30.0) -> Motion:
    """A quarter turn to the left on the spot, left foot first; each round continues from the one before."""
    phase = _phase(rounds, _TURN_SECONDS, fps)
    quarter = np.pi / 2
    looking, going = (_steps(phase, *span) * quarter for span in ((0.02, 0.72), (0.1, 0.86)))
    feet = {
        side: _stepping(phase, span, sign)
        for side, span, sign in (("left", (0.1, 0.44), 1), ("right", (0.5, 0.86), -1))
    }
    weight = np.sin(2 * np.pi * (phase - 0.02))
    local = np.stack([-0.045 * weight, -0.022 + 0.006 * np.cos(4 * np.pi * phase), np.zeros_like(phase)], -1)
    place = np.einsum("fij,fj->fi", about_axis(1, going), local)
    ahead = np.degrees(looking - going)
    pose = Pose(
        Arm(down=73, elbow=20 + 4 * weight, swing=3 - 6 * weight, forearm=-10),
        Arm(down=73, elbow=20 - 4 * weight, swing=3 + 6 * weight, forearm=-10),
        Leg(),
        Leg(),
        trunk=(2.0, 0.5 * ahead, 1.5 * weight),
        head=(2.0, 0.8 * ahead, 0.0),
    )
    rotations = pose.rotations()
    rotations[:, 0] = about_axis(1, going) @ about_axis(2, np.radians(1.5 * weight))
    return Motion(reach(rotations, place, feet), place, fps, "Turn Left")


MOTIONS: dict[str, BuiltIn] = {
    "WALK": BuiltIn("Walk", "An easy walk straight ahead; the feet do not slide", CYCLE_SECONDS, True, walk),
    "IDLE": BuiltIn("Idle", "Standing, breathing, the weight going from leg to leg", _IDLE_SECONDS, True, idle),
    "WAVE": BuiltIn("Wave", "Standing and waving with the right hand", _WAVE_SECONDS, True, wave),
    "TURN": BuiltIn("Turn Left", "A quarter turn to the left in two steps", _TURN_SECONDS, False, turn),
}
"""By the names that operators use."""


def _phase(rounds: int, seconds: float, fps: float) -> NDArray[np.float64]:
    """Rounds at each frame [F]; the first and the last frame are whole numbers."""
    return np.arange(round(rounds * seconds * fps) + 1) / (seconds * fps)


def _standing(pose: Pose, place: NDArray, fps: float, name: str) -> Motion:
    """A motion over feet that stay where they are."""
    rotations = pose.rotations()
    rotations = np.array(np.broadcast_to(rotations, (len(place), 24, 3, 3)))
    still = np.zeros(len(place))
    feet = {
        side: FootTrack(np.tile(_ankle(side, sign), (len(place), 1)), still, still, still + sign * _TOES_OUT)
        for side, sign in (("left", 1), ("right", -1))
    }
    return Motion(reach(rotations, place, feet), place, fps, name)


def _ankle(side: str, sign: int) -> NDArray[np.float64]:
    """Position of an ankle in a standing pose."""
    return joint(f"{side}_ankle") * [0, 1, 1] + [sign * 0.105, 0.0, 0.0]


def _stepping(phase: NDArray, span: tuple[float, float], sign: int) -> FootTrack:
    """A foot that moves a quarter circle about the pelvis during `span` of each round, and stands otherwise."""
    progress = _steps(phase, *span)
    angle = progress * np.pi / 2
    centre = REST_JOINTS[0] * [1, 0, 1]
    arm = _ankle("left" if sign > 0 else "right", sign) - centre
    ankle = centre + np.einsum("fij,j->fi", about_axis(1, angle), arm)
    share = progress - np.floor(progress)
    lift = np.sin(np.pi * share)
    ankle[:, 1] += 0.07 * lift
    return FootTrack(ankle, np.radians(-16) * lift, np.radians(8) * lift, angle + sign * _TOES_OUT)


def _steps(phase: NDArray, begin: float, end: float) -> NDArray[np.float64]:
    """Rises by 1 in each round, between the shares `begin` and `end` of it."""
    whole = np.floor(phase)
    return whole + _ease((phase - whole - begin) / (end - begin))


def _ease(t: NDArray) -> NDArray[np.float64]:
    t = np.clip(t, 0.0, 1.0)
    return t * t * t * (t * (6 * t - 15) + 10)
