"""Units, axes and place of a scan: from the human in it, or from the body that its parameters describe."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from mathutils.kdtree import KDTree
from numpy.typing import NDArray

from ..files.regular_files import FileError
from ..scene.convention import BLENDER_FROM_BACKEND

SHORTEST, TALLEST = 0.5, 2.6
"""Heights of humans in metres: less than a power of ten apart."""
_WIDEST = 10.0
"""Largest extent of a scan, metres: one stray vertex would move the cameras far away."""
_UNITS = {1.0: "", 0.01: "centimetres", 0.001: "millimetres", 100.0: "hundreds of metres", 1000.0: "kilometres"}


@dataclasses.dataclass(frozen=True)
class Standing:
    """What turns and scales an imported scan into metres, z up, facing -y."""

    rotation: NDArray[np.float64]
    """[3, 3], Blender's axes."""
    scale: float
    notes: list[str]


def stand_up(axes: NDArray, points: NDArray, name: str) -> Standing:
    """Upright, from the axes left, up and front of a human (columns [3, 3]) and its surface [V, 3], as imported.

    Raises FileError where no power of ten makes it a person's height.
    """
    rotation = BLENDER_FROM_BACKEND @ np.asarray(axes).T
    up = np.asarray(axes)[:, 1]
    along = np.asarray(points) @ up
    height = float(along.max() - along.min())
    scale = unit_of(height, name)
    reach = float(np.ptp(points, axis=0).max()) * scale
    if not reach <= _WIDEST:
        raise FileError(name, f"has points {reach:.4g} m apart", "remove what is not the person, or lost vertices")
    notes = [f"{height * scale:.2f} m tall", scale_note(scale)]
    tilt = np.degrees(np.arccos(np.clip(up[2], -1, 1)))
    if tilt > 1:
        notes.append(f"{axis_name(up)} was up after import: turned upright")
    yaw = np.degrees(np.arctan2(rotation[1, 0], rotation[0, 0])) if tilt <= 1 else 0.0
    if abs(yaw) > 1:
        notes.append(f"turned by {yaw:.0f} degrees to face forward")
    return Standing(rotation, scale, [note for note in notes if note])


def unit_of(height: float, name: str) -> float:
    """The power of ten that makes `height` a person's in metres. Raises FileError where there is none."""
    for scale in (1.0, 0.01, 100.0, 0.001, 1000.0, 0.1, 10.0):
        if SHORTEST <= height * scale <= TALLEST:
            return scale
    reason = f"is {height:.4g} m tall, and no change of units makes that a person of {SHORTEST:g} to {TALLEST:g} m"
    raise FileError(name, reason, "scale it to metres")


def scale_note(scale: float) -> str:
    """A note on a corrected scale; empty for 1."""
    if scale == 1.0:
        return ""
    unit = (
        f"its unit seems to be {_UNITS[scale]}"
        if scale in _UNITS
        else "it is ten times too " + ("large" if scale < 1 else "small")
    )
    return f"scaled by {scale:g}: {unit}"


def axis_name(direction: NDArray) -> str:
    """The axis nearest to a direction, such as "z" or "-y"."""
    largest = int(np.abs(direction).argmax())
    return ("-" if direction[largest] < 0 else "") + "xyz"[largest]


_SAMPLES = 300
_AS_GIVEN = 0.7
"""A scan stays as it is unless another registration is this much nearer."""


@dataclasses.dataclass(frozen=True, eq=False)
class Registration:
    """x_body = scale * rotation @ x_scan + shift."""

    rotation: NDArray[np.float64]
    """[3, 3], whole quarter turns."""
    scale: float
    """A power of ten."""
    shift: NDArray[np.float64]
    """[3], metres."""
    distance: float
    """Mean of the distances of the scan's points to the body and of the body's to the scan, metres."""

    def apply(self, points: NDArray) -> NDArray[np.float64]:
        """Points [V, 3] of the scan, where the body is."""
        return self.scale * np.asarray(points) @ self.rotation.T + self.shift


def register(scan: NDArray, body: NDArray) -> Registration:
    """Surface points of a scan [V, 3] and vertices of a posed body [W, 3], both in the same axes if all is well.

    Tried are powers of ten that make them equally large, the 24 quarter turns, and moving the middle of one onto the
    other's; as given counts unless another is far nearer.
    """
    scale = 10.0 ** round(np.log10(_size(body) / max(_size(scan), 1e-30)))
    few = scan[:: max(1, len(scan) // _SAMPLES)]
    tree, body_few = _tree(body), body[:: max(1, len(body) // _SAMPLES)]
    many = scan[:: max(1, len(scan) // 5000)]
    tried = []
    for rotation in _quarter_turns():
        turned = scale * few @ rotation.T
        all_turned = scale * many @ rotation.T
        back = _tree(all_turned)
        for shift in (np.zeros(3), _middle(body) - _middle(all_turned)):
            there = np.mean([tree.find(point)[2] for point in turned + shift])
            here = np.mean([back.find(point)[2] for point in body_few - shift])
            as_given = np.array_equal(rotation, np.eye(3)) and not shift.any()
            distance = float((there + here) / 2)
            tried.append((distance * (_AS_GIVEN if as_given else 1.0), len(tried), rotation, shift, distance))
    _, _, rotation, shift, distance = min(tried)
    return Registration(rotation, scale, shift, distance)


def _size(points: NDArray) -> float:
    return float(np.linalg.norm(points.max(0) - points.min(0)))


def _middle(points: NDArray) -> NDArray[np.float64]:
    return (points.max(0) + points.min(0)) / 2


def _tree(points: NDArray) -> KDTree:
    tree = KDTree(len(points))
    for number, point in enumerate(points):
        tree.insert(point, number)
    tree.balance()
    return tree


def _quarter_turns() -> list[NDArray[np.float64]]:
    """The 24 rotations that take axes to axes, the identity first."""
    turns = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]
    return [turn for turn in turns if np.linalg.det(turn) > 0]
