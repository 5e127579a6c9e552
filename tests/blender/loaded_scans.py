"""Scans on the default body, loaded, and how far their vertices are from it."""

from pathlib import Path

import bpy
import numpy as np
import scan_fixtures
from blender_primdiffusion.formats.poses.rotation import from_axis_angle

from blender_primdiffusion.capture.body import read_body
from blender_primdiffusion.capture.scan import Scan, load_scan
from blender_primdiffusion.capture.scan_files import find_scans

BODY = read_body()
RNG = np.random.default_rng(0)
BETAS = RNG.normal(0, 1, 10)
ROTATIONS = from_axis_angle(RNG.normal(0, 0.4, (24, 3)))
MOVE = np.array([0.3, 0.2, -0.1])


def load(path: Path) -> Scan:
    return load_scan(bpy.context, find_scans(path)[0], BODY)


def distance_m(scan: Scan, vertices: np.ndarray) -> np.ndarray:
    """From every seventh evaluated vertex of the scan to the nearest of `vertices` [V, 3]."""
    from mathutils.kdtree import KDTree

    tree = KDTree(len(vertices))
    for number, point in enumerate(vertices):
        tree.insert(point, number)
    tree.balance()
    return np.array([tree.find(point)[2] for point in scan_fixtures.evaluated(scan.objects)[::7]])
