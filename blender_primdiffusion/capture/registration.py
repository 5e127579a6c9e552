"""A scan and the body that is said to be in it: units, axes and place, found by trying those that files come in."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from mathutils.kdtree import KDTree
from numpy.typing import NDArray

_SAMPLES = 300
_AS_GIVEN = 0.7
"""A scan is left as it is unless another way is this much nearer."""


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
