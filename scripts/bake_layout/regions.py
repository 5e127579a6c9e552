"""Cuts the half body into six regions along smooth curves."""

from __future__ import annotations

import numpy as np
from half_body import Sheet
from numpy import ndarray as Array

REGIONS = ("torso", "head", "arm", "hand", "leg", "foot")
SNAP = 0.2
"""A cut closer to an edge's end than this share of the edge goes through that end, which avoids needle triangles."""


def cut_into_regions(sheet: Sheet, joints: dict[str, Array]) -> tuple[Sheet, Array]:
    """The sheet with faces split along the cuts, and the region of each face as an index into REGIONS.

    The cuts are placed relative to the joints, so they follow the body's proportions: a plane across the neck that
    slopes towards the chin, a plane through the armpit, a wrist and an ankle plane, and a groin line that rises
    outwards.
    """
    neck, shoulder, wrist = joints["neck"], joints["left_shoulder"], joints["left_wrist"]
    ankle, pelvis = joints["left_ankle"], joints["pelvis"]
    crotch = sheet.points[sheet.midline, 1].min()

    def head(p: Array) -> Array:
        above_neck = p[:, 1] - neck[1] + 0.014 - 0.6 * np.maximum(p[:, 0] - 0.054, 0)
        return above_neck * np.cos(0.45) + p[:, 2] * np.sin(0.45)

    def arm(p: Array) -> Array:
        beside = p[:, 0] - shoulder[0] - 0.01 + 0.5 * (p[:, 1] - shoulder[1])
        return np.minimum(beside, p[:, 1] - shoulder[1] + 0.19)

    def hand(p: Array) -> Array:
        return p[:, 0] - wrist[0] + 0.004

    def leg(p: Array) -> Array:
        return np.minimum(crotch + 0.013 + 0.2 * np.maximum(p[:, 0] - 0.022, 0) - p[:, 1], pelvis[1] + 0.2 - p[:, 1])

    def foot(p: Array) -> Array:
        return ankle[1] + 0.02 - p[:, 1]

    region = np.zeros(len(sheet.faces), dtype=int)
    for inside, found_in, name in (
        (head, "torso", "head"),
        (arm, "torso", "arm"),
        (hand, "arm", "hand"),
        (leg, "torso", "leg"),
        (foot, "leg", "foot"),
    ):
        sheet, region, positive = _split(sheet, region, inside(sheet.points), REGIONS.index(found_in))
        region = np.where(positive & (region == REGIONS.index(found_in)), REGIONS.index(name), region)
    return sheet, region


def _split(sheet: Sheet, region: Array, value: Array, only: int) -> tuple[Sheet, Array, Array]:
    """Splits the faces of region `only` where `value` (one per point, linear on edges) changes sign.

    Returns the sheet, the regions of its faces and which faces are on the positive side.
    """
    value = value.copy()
    subject = sheet.faces[region == only]
    edges = np.unique(np.sort(subject[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    crossing = edges[value[edges[:, 0]] * value[edges[:, 1]] < 0]
    share = value[crossing[:, 0]] / (value[crossing[:, 0]] - value[crossing[:, 1]])
    value[crossing[share < SNAP, 0]] = 0
    value[crossing[share > 1 - SNAP, 1]] = 0
    points, midline, middle = list(sheet.points), list(sheet.midline), {}
    for a, b in crossing:
        if value[a] * value[b] < 0:
            t = value[a] / (value[a] - value[b])
            middle[a, b] = middle[b, a] = len(points)
            points.append(points[a] * (1 - t) + points[b] * t)
            midline.append(midline[a] and midline[b])
    faces, parent, regions, positive = [], [], [], []
    for face, old_parent, old_region in zip(sheet.faces.tolist(), sheet.parent, region, strict=True):
        pieces = _pieces(face, middle)
        faces += pieces
        parent += [old_parent] * len(pieces)
        regions += [old_region] * len(pieces)
        for piece in pieces:
            known = [value[v] for v in piece if v < len(value)]
            positive.append(sum(known) > 0)
    return (
        Sheet(np.array(points), np.array(faces), np.array(parent), np.array(midline)),
        np.array(regions),
        np.array(positive),
    )


def _pieces(face: list[int], middle: dict[tuple[int, int], int]) -> list[list[int]]:
    """A triangle cut at the new points on its edges, with the same orientation."""
    new = [middle.get((face[k], face[(k + 1) % 3])) for k in range(3)]
    cuts = [k for k in range(3) if new[k] is not None]
    if not cuts:
        return [face]
    if len(cuts) == 1:
        k = cuts[0]
        a, b, c = face[k], face[(k + 1) % 3], face[(k + 2) % 3]
        return [[a, new[k], c], [new[k], b, c]]
    k = next(k for k in range(3) if new[k] is not None and new[(k + 1) % 3] is not None)
    a, b, c = face[k], face[(k + 1) % 3], face[(k + 2) % 3]
    p, q = new[k], new[(k + 1) % 3]
    return [[p, b, q], [a, p, q], [a, q, c]]
