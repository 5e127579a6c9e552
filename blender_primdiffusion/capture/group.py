"""Scans that stand together on a floor, in front of the same cameras. Each is rendered alone."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence

import bpy
import numpy as np
from numpy.typing import NDArray

from ..formats.camera_rig import View, bounding_sphere, extent, first_frames, stand_together
from ..formats.capture_layout import view_seed
from ..formats.poses.motion import Motion
from .body import Body
from .scan import Scan
from .scan_files import ScanFile
from .settings import CaptureSettings
from .stage import CaptureScene


@dataclasses.dataclass(frozen=True)
class Placed:
    """A subject of a group."""

    poses: Motion
    """Its own, at its places."""
    views: list[View]
    """Views of the whole group."""
    first: str
    """Name of the first of the group, whose seeds choose the HDRIs."""


def groups_of(ordered: Sequence[ScanFile], size: int) -> Iterator[Sequence[ScanFile]]:
    """Split the sorted scans of all shards into groups."""
    for first in range(0, len(ordered), size):
        yield ordered[first : first + size]


def place_group(
    context: bpy.types.Context, settings: CaptureSettings, group: Sequence[ScanFile], poses: Motion, body: Body, load
) -> dict[str, Placed]:
    """Load every scan of a group, draw places, and return poses and cameras by name.

    The places depend on the seed and the scans alone. Raises as `load`.
    """
    rng = np.random.default_rng(view_seed(settings.seed, group[0].name, 0, 0))
    yaws = rng.uniform(-math.pi, math.pi, (len(group), len(poses)))
    own, pelvis, extents = [], [], []
    for scan_file, first, yaw in zip(group, first_frames(len(group), len(poses)), yaws, strict=True):
        rotations = np.roll(poses.rotations, -first, axis=0)
        rotations[:, 0] = _about_the_vertical(yaw) @ rotations[:, 0]
        own.append(rotations)
        with contextlib.closing(CaptureScene(context, settings)) as stage, stage.entered() as inside:
            scan = load(inside, scan_file, body)
            pelvis.append([scan.pose(rotation, np.zeros(3))[0] for rotation in rotations])
            extents.append([_extent(scan, *pose) for pose in zip(rotations, pelvis[-1], strict=True)])
    moves, corners = stand_together(np.array(pelvis), np.array(extents), rng)
    views = list(settings.cameras) or settings.rig.views(*bounding_sphere(corners))
    return {
        scan_file.name: Placed(dataclasses.replace(poses, rotations=rotations, translations=move), views, group[0].name)
        for scan_file, rotations, move in zip(group, own, moves, strict=True)
    }


def _about_the_vertical(yaw: NDArray) -> NDArray[np.float64]:
    turns = np.zeros((len(yaw), 3, 3))
    turns[:, 0, 0], turns[:, 0, 2], turns[:, 1, 1] = np.cos(yaw), np.sin(yaw), 1
    turns[:, 2, 0], turns[:, 2, 2] = -np.sin(yaw), np.cos(yaw)
    return turns


def _extent(scan: Scan, rotations: NDArray, pelvis: NDArray) -> tuple[float, float, float]:
    """`extent` of the box around a scan in a pose."""
    points = scan.bounds(rotations[None], np.zeros((1, 3)))
    corners = np.array(list(itertools.product(*zip(points.min(0), points.max(0), strict=True))))
    return extent(corners, pelvis)
