"""The default body as people's rigs have it, in motions and in scans: how many are read, stand, and keep their size.

    python real_rigs.py    # prints figures as a line of JSON

The bones of the scans begin where those of such rigs do, centimetres from the body's joints; the motion of Rokoko has
all bones along x at rest, all motions are in centimetres and begin close to a T pose.
"""

import json
import tempfile
from pathlib import Path

import bpy
import numpy as np
import scan_fixtures
from blender_primdiffusion.formats.joints import JOINT_NAMES
from blender_primdiffusion.formats.poses.files import read_motion
from blender_primdiffusion.formats.poses.skeleton import REST_JOINTS, joint_positions
from bvh_files import FRAMES, along_x, motion_of, write_bvh
from mathutils import Vector

from blender_primdiffusion.capture.body import Body, read_body
from blender_primdiffusion.capture.scan import load_scan
from blender_primdiffusion.capture.scan_files import find_scans
from blender_primdiffusion.scene.convention import points_to_blender

RIGS = ("MIXAMO", "RPM", "ROKOKO", "VROID", "SOMA")
NEAR_M = 0.06
"""Largest distance of a limb's joint from where the body has it for a person to count as upright."""
MIDDLE = {"pelvis": (0, 0.1, 0), "spine1": (0, 0.14, 0.02), "spine2": (0, 0.18, 0.02), "spine3": (0, 0.22, 0.02),
          "neck": (0, 0.06, -0.05), "head": (0, 0.04, -0.02)}  # fmt: skip
LEFT = {"hip": (-0.03, 0.06, 0), "knee": (-0.03, 0.04, 0), "shoulder": (-0.03, 0.03, -0.03), "elbow": (0, 0.03, -0.03),
        "wrist": (0.03, 0.03, -0.03), "foot": (0, 0.02, 0.04)}  # fmt: skip
"""Where bones of such rigs begin, seen from the body's joints, metres; the right side mirrors the left."""
COMPARED = [JOINT_NAMES.index(f"{side}_{part}") for side in ("left", "right") for part in ("knee", "ankle", "elbow")]


def motion_stands(folder: Path, rig: str) -> bool:
    """Write and read a motion; whether its limbs are where they were. Raises FileError where it is not read."""
    rotations, _ = motion_of(0.3, 4)
    rotations[0], rotations[:, 22:] = np.eye(3), np.eye(3)
    rest, written = along_x(REST_JOINTS, rotations) if rig == "ROKOKO" else (REST_JOINTS, rotations)
    root = np.tile(REST_JOINTS[0], (FRAMES, 1))
    path = write_bvh(folder / f"{rig}.bvh", 100 * rest, written, 100 * root, getattr(scan_fixtures, rig))
    off = np.linalg.norm(read_motion(path).joints() - joint_positions(rotations), axis=-1)
    return bool(off[:, COMPARED].max() < NEAR_M)


def scan_stands(folder: Path, rig: str, body: Body) -> tuple[bool, float]:
    """Write and load a scan: whether its limbs are where they were, and the error of its size as a fraction."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    names, betas = getattr(scan_fixtures, rig), np.random.default_rng(3).normal(size=10)
    _, armature = scan_fixtures.person(body, betas, None, names)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for joint, name in enumerate(JOINT_NAMES):
        armature.data.edit_bones[names[name]].translate(Vector(points_to_blender(offsets()[joint]).tolist()))
    bpy.ops.object.mode_set(mode="OBJECT")
    path = scan_fixtures.save(folder / f"{rig}.glb")
    scan = load_scan(bpy.context, find_scans(path)[0], body)
    vertices, joints = body.rest(betas)
    rest = np.tile(np.eye(3), (24, 1, 1))
    off = np.linalg.norm(scan.pose(rest, np.zeros(3)) - joints - offsets(), axis=-1)
    height = np.ptp(scan_fixtures.evaluated(scan.objects)[:, 1])
    return bool(off[COMPARED].max() < 2 * NEAR_M), abs(float(height / np.ptp(vertices[:, 1])) - 1)


def offsets() -> np.ndarray:
    """Of all joints [24, 3]."""
    found = np.zeros((24, 3))
    for joint, name in enumerate(JOINT_NAMES):
        side, _, part = name.partition("_")
        found[joint] = LEFT.get(part, (0, 0, 0)) if part else MIDDLE[name]
        if part and side == "right":
            found[joint, 0] *= -1
    return found


def figures() -> dict[str, float]:
    """Motions and scans that are read, and that stand, and the largest error of a scan's size."""
    read, upright, errors, body = 0, 0, [], read_body()
    with tempfile.TemporaryDirectory(prefix="primdiffusion_rigs_") as folder:
        for rig in RIGS:
            for attempt in ("motion", "scan"):
                try:
                    if attempt == "motion":
                        stands = motion_stands(Path(folder), rig)
                    else:
                        stands, error = scan_stands(Path(folder), rig, body)
                        errors.append(error)
                except ValueError as error:
                    print(f"{rig}, {attempt}: {error}")
                    continue
                read, upright = read + 1, upright + stands
    return {
        "real_rigs": 2 * len(RIGS),
        "real_rigs_read": read,
        "real_rigs_upright": upright,
        "capture_scale_error_max": round(max(errors), 4),
    }


if __name__ == "__main__":
    print(json.dumps(figures()))
