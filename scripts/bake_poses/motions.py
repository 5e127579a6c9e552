"""One round of each built-in motion, for the average skeleton standing on the floor: walk, idle, wave, turn."""

from __future__ import annotations

import numpy as np
from blender_primdiffusion.formats.poses.motion import Motion
from blender_primdiffusion.formats.poses.rotation import about_axis
from blender_primdiffusion.formats.poses.skeleton import REST_JOINTS
from numpy.typing import NDArray

from blender_primdiffusion.motion.poses import FLOOR

from .legs import FootTrack, joint, leg_length, reach
from .limbs import Arm, Leg, Pose

CYCLE_SECONDS = 1.1
"""Two steps."""
STRIDE = 1.28
"""Length of two steps in metres: 1.16 m/s."""
_STANCE = 0.62
"""Share of the cycle for which a foot is on the floor."""
_FLAT = (0.1, 0.38)
"""Between these shares the whole sole is on the floor; before, only the heel, afterwards only the ball."""
_STRIKE, _PUSH = np.radians(17.0), np.radians(-50.0)
"""Pitch of the foot at heel strike, and at toe-off."""
_AHEAD = 0.255
"""Distance ahead of the pelvis at which a foot is put down, in strides."""
_APART = 0.065
"""From the middle to an ankle, metres: walking feet are closer together than standing ones."""
_WALK_TOES_OUT = np.radians(6.0)
_HEEL, _BALL = np.array([-0.079, -0.052]), np.array([-0.079, 0.147])
"""Contacts of the sole from the ankle: up, forward, metres."""
_CLEARANCE = 0.03
"""Additional height of a swinging foot in metres, since toes would touch the floor."""
_STRETCH = 0.997
"""Longest reach of a leg that carries, as a share of its length."""


def walk() -> Motion:
    """Two steps forward along +z; the last frame is the first, a stride further on.

    Feet do not slide: legs reach for feet that stay where they were put down, on heel, sole and ball in turn.
    """
    phase = _phase(CYCLE_SECONDS, 60.0)
    feet = {"left": _foot(phase, 0.0, 1), "right": _foot(phase, 0.5, -1)}
    turned = np.radians(
        [
            np.full_like(phase, 2.0),
            -5.0 * _wave(phase),
            3.0 * _wave(phase - 0.14),
        ]
    )
    pelvis = about_axis(1, turned[1]) @ about_axis(2, turned[2]) @ about_axis(0, turned[0])
    place = np.stack([0.02 * _wave(phase - 0.3), np.zeros_like(phase), STRIDE * phase], -1)
    place[:, 1] = _carried(phase, pelvis, place, feet)
    rotations = _upper_body(phase)
    rotations[:, 0] = pelvis
    return Motion(reach(rotations, place, feet), place, 60.0, "Walk")


def _wave(phase: NDArray) -> NDArray[np.float64]:
    return np.cos(2 * np.pi * phase)


def _upper_body(phase: NDArray) -> NDArray[np.float64]:
    """Shoulders turn against the pelvis, arms swing against the legs, the head looks ahead [F, 24, 3, 3]."""
    swing = _wave(phase + 0.02)
    pose = Pose(
        Arm(down=79, swing=3 - 23 * swing, elbow=24 - 11 * swing, forearm=-8, twist=6),
        Arm(down=79, swing=3 + 23 * swing, elbow=24 + 11 * swing, forearm=-8, twist=6),
        Leg(),
        Leg(),
        trunk=(2.0, 11 * _wave(phase), 2.0 * _wave(phase - 0.14)),
        head=(-2.0 + 1.0 * _wave(2 * phase), -6 * _wave(phase), 0.5 * _wave(phase - 0.14)),
    )
    return pose.rotations()


def _foot(phase: NDArray, lag: float, sign: int) -> FootTrack:
    """The foot that comes down on its heel `lag` of a cycle after whole phases; `sign` is 1 for the left."""
    start = np.floor(phase - lag) + lag
    share = phase - start
    up, ahead, pitch = _stance(share)
    swing = share >= _STANCE
    over = np.clip((share - _STANCE) / (1 - _STANCE), 0.0, 1.0)
    landed = np.array(_stance(np.array(0.0))) + np.array([0.0, STRIDE, 0.0])
    flown = [
        _hermite(over, a, b, da, db)
        for a, b, da, db in zip(_stance(np.array(_STANCE)), landed, _slope(_STANCE - 1e-4), _slope(1e-4), strict=True)
    ]
    flown[0] = flown[0] + _CLEARANCE * 16 * over**2 * (1 - over) ** 2
    up, ahead, pitch = (np.where(swing, f, s) for f, s in zip(flown, (up, ahead, pitch), strict=True))
    toes = np.where(swing, np.maximum(-_PUSH, 0) * (1 - _smooth(over / 0.5)), np.maximum(-pitch, 0.0))
    side = np.full_like(phase, sign * _APART)
    ankle = np.stack([side, up, ahead + STRIDE * (start + _AHEAD)], -1)
    return FootTrack(ankle, pitch, toes, np.full_like(phase, sign * _WALK_TOES_OUT))


def _stance(share: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Height of the ankle, its place ahead of where it is with the sole flat, and the pitch, of a foot on the floor."""
    begin, end = _FLAT
    down = _STRIKE * (1 - _smooth(share / begin))
    lifted = np.clip((share - end) / (_STANCE - end), 0.0, 1.0)
    pitch = np.where(share < begin, down, _PUSH * lifted**2 * (1.6 - 0.6 * lifted))
    contact = np.where((share < begin)[..., None], _HEEL, _BALL)
    turned = _pitched(contact, pitch)
    return FLOOR - turned[..., 0], contact[..., 1] - turned[..., 1], pitch


def _pitched(contact: NDArray, pitch: NDArray) -> NDArray[np.float64]:
    """Contacts [..., 2] (up, forward) of a foot whose toes are raised by `pitch`."""
    sine, cosine = np.sin(pitch), np.cos(pitch)
    up, ahead = contact[..., 0], contact[..., 1]
    return np.stack([up * cosine + ahead * sine, ahead * cosine - up * sine], -1)


def _slope(share: float) -> NDArray[np.float64]:
    """Derivative of `_stance`, per swing of the foot."""
    step = 1e-4
    before, after = (np.array(_stance(np.array(share + d))) for d in (-step, step))
    return (after - before) / (2 * step) * (1 - _STANCE)


def _hermite(t: NDArray, a: float, b: float, da: float, db: float) -> NDArray[np.float64]:
    """From `a` with slope `da` to `b` with slope `db` as t goes from 0 to 1."""
    return (2 * t**3 - 3 * t**2 + 1) * a + (t**3 - 2 * t**2 + t) * da + (3 * t**2 - 2 * t**3) * b + (t**3 - t**2) * db


def _smooth(t: NDArray) -> NDArray[np.float64]:
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3 - 2 * t)


def _carried(phase: NDArray, pelvis: NDArray, place: NDArray, feet: dict[str, FootTrack]) -> NDArray[np.float64]:
    """Heights [F] of the pelvis above its rest position: up and down twice a cycle, within reach of the legs."""
    highest = np.full(len(phase), np.inf)
    for side, foot in feet.items():
        hip = REST_JOINTS[0] + place + pelvis @ (joint(f"{side}_hip") - REST_JOINTS[0])
        level = np.linalg.norm((foot.ankle - hip)[:, [0, 2]], axis=-1)
        highest = np.minimum(highest, foot.ankle[:, 1] + np.sqrt((_STRETCH * leg_length()) ** 2 - level**2) - hip[:, 1])
    angle = 4 * np.pi * phase
    basis = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], -1)
    height = basis @ np.linalg.lstsq(basis, highest, rcond=None)[0]
    return height - np.maximum(height - highest, 0.0).max()


_TOES_OUT = np.radians(9.0)
_IDLE_SECONDS, _WAVE_SECONDS, _TURN_SECONDS = 6.0, 3.0, 2.4


def idle() -> Motion:
    """Standing: the weight shifts from leg to leg and back, two breaths; the feet stay."""
    phase = _phase(_IDLE_SECONDS, 30.0)
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
        30.0,
        "Idle",
    )


def wave() -> Motion:
    """Standing; the right hand goes up, waves and comes down."""
    share = _phase(_WAVE_SECONDS, 60.0)
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
        60.0,
        "Wave",
    )


def turn() -> Motion:
    """A quarter turn to the left on the spot, left foot first; the last frame is the first, turned."""
    phase = _phase(_TURN_SECONDS, 60.0)
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
    return Motion(reach(rotations, place, feet), place, 60.0, "Turn Left")


def _phase(seconds: float, fps: float) -> NDArray[np.float64]:
    """The share of the round at each frame [F], from 0 to 1."""
    return np.linspace(0.0, 1.0, round(seconds * fps) + 1)


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
