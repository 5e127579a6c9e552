"""The built-in walk: first the feet, then a pelvis that they can carry, then legs, trunk and arms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .motion import Motion
from .poses import Arm, Leg, Pose
from .rotation import about_axis
from .skeleton import FLOOR, REST_JOINTS, FootTrack, joint, leg_length, reach

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
_TOES_OUT = np.radians(6.0)
_HEEL, _BALL = np.array([-0.079, -0.052]), np.array([-0.079, 0.147])
"""Contacts of the sole from the ankle: up, forward, metres."""
_CLEARANCE = 0.03
"""Additional height of a swinging foot in metres, since toes would touch the floor."""
_STRETCH = 0.997
"""Longest reach of a leg that carries, as a share of its length."""


def walk(cycles: int = 2, fps: float = 30.0) -> Motion:
    """A walk forward along +z at `fps` frames per second; the last frame is the first, `cycles` strides further on.

    Feet do not slide: legs reach for feet that stay where they were put down, on heel, sole and ball in turn.
    """
    count = round(cycles * CYCLE_SECONDS * fps)
    phase = np.arange(count + 1) / count * cycles
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
    return Motion(reach(rotations, place, feet), place, count / (cycles * CYCLE_SECONDS), "Walk")


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
    return FootTrack(ankle, pitch, toes, np.full_like(phase, sign * _TOES_OUT))


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
