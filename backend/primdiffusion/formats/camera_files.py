"""Camera files of a capture for other projects: the released code, OpenCV, NeRF, COLMAP."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .camera_rig import View
from .capture_layout import picture_path, write_npz
from .requests import LAYOUTS
from .whole_files import write_atomically

_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])


def write_layouts(subject: Path, views: Sequence[View], frames: int, layouts: Sequence[str] = LAYOUTS) -> None:
    """Write cameras.json, and the files of other `layouts` for all frames. Raises OSError."""
    write_cameras(subject, views)
    if "opencv" in layouts:
        write_opencv(subject, views)
    for frame in range(frames):
        if "nerf" in layouts:
            write_nerf(subject, views, frame)
        if "colmap" in layouts:
            write_colmap(subject, views, frame)


def write_cameras(subject: Path, views: Sequence[View]) -> None:
    """Write cameras.json for the released code."""
    named = {
        f"camera{i:04d}": {"K": v.intrinsics.tolist(), "R": v.rotation.tolist(), "T": v.translation.tolist()}
        for i, v in enumerate(views)
    }
    write_atomically(subject / "cameras.json", json.dumps(named, indent=1))


def write_opencv(subject: Path, views: Sequence[View]) -> None:
    """Write K, R, T of all cameras as arrays."""
    write_npz(
        subject / "opencv" / "cameras.npz",
        K=np.stack([view.intrinsics for view in views]),
        R=np.stack([view.rotation for view in views]),
        T=np.stack([view.translation for view in views]),
        width=np.array([view.width for view in views]),
        height=np.array([view.height for view in views]),
    )


def write_nerf(subject: Path, views: Sequence[View], frame: int) -> None:
    """Write transforms.json of one frame, for instant-ngp and nerfstudio."""
    frames = []
    for i, view in enumerate(views):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = view.rotation.T @ _FROM_OPENGL, view.position
        path = os.path.relpath(picture_path(subject, "img", i, frame), subject / "nerf" / f"{frame:04d}")
        k = view.intrinsics
        frames.append(
            {
                "file_path": Path(path).as_posix(),
                "transform_matrix": matrix.tolist(),
                **{"fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]},
                **{"w": view.width, "h": view.height},
            }
        )
    first = views[0]
    angle = 2 * float(np.arctan(first.width / (2 * first.intrinsics[0, 0])))
    record = {"camera_model": "OPENCV", "camera_angle_x": angle, "frames": frames}
    write_atomically(subject / "nerf" / f"{frame:04d}" / "transforms.json", json.dumps(record, indent=1))


def write_colmap(subject: Path, views: Sequence[View], frame: int) -> None:
    """Write COLMAP's text model of one frame, without points; image names are relative to the folder img."""
    cameras, images = (
        ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"],
        ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, ID, NAME"],
    )
    for i, view in enumerate(views, start=1):
        k, q, t = view.intrinsics, _quaternion(view.rotation), view.translation
        size = f"{view.width} {view.height}"
        cameras.append(f"{i} PINHOLE {size} {k[0, 0]:.17g} {k[1, 1]:.17g} {k[0, 2]:.17g} {k[1, 2]:.17g}")
        pose = " ".join(f"{value:.17g}" for value in (*q, *t))
        name = picture_path(subject, "img", i - 1, frame).relative_to(subject / "img").as_posix()
        images += [f"{i} {pose} {i} {name}", ""]
    files = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": ["# no points"]}
    for file, lines in files.items():
        write_atomically(subject / "colmap" / f"{frame:04d}" / file, "\n".join(lines) + "\n")


def _quaternion(rotation: NDArray) -> NDArray[np.float64]:
    """Convert to w, x, y, z with w >= 0: the eigenvector of Bar-Itzhack's matrix with the largest eigenvalue."""
    m = rotation
    matrix = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], 0, 0, 0],
            [m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0, 0],
            [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1], 0],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
        ]
    )
    x, y, z, w = np.linalg.eigh(matrix)[1][:, -1]
    q = np.array([w, x, y, z])
    return -q if w < 0 else q
