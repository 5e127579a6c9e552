"""Camera files of captures for other projects: NeRF, OpenCV and COLMAP.

root/{id}/nerf/FFFF/transforms.json                  camera to world, OpenGL axes; one static scene a frame
root/{id}/opencv/cameras.npz                         K [C,3,3], R [C,3,3], T [C,3], width, height
root/{id}/colmap/FFFF/{cameras,images,points3D}.txt  text model without points; names relative to img
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from primdiffusion.capture.reader import Captures, Subject
from primdiffusion.files.regular_files import check_inside
from primdiffusion.files.whole_files import write_atomically
from primdiffusion.formats.capture_layout import npz_bytes, picture_path

Project = Literal["nerf", "opencv", "colmap"]
_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])


def export_cameras(captures: Captures, projects: Sequence[Project]) -> Iterator[str]:
    """Write the camera files of every subject, for all its frames; yields the name of each finished subject.

    Files that are there are kept.

    Raises:
        ValueError: the captures have no images that the files could name.
        FileNotFoundError, FileError: captures are missing or damaged, or a link leads out of their folder.
        OSError: a file cannot be written.
    """
    if "img" not in captures.passes:
        raise ValueError(f"{captures.root} has no pass img, whose images camera files name: render it")
    for name in captures.subjects:
        subject = captures.subject(name)
        for project in projects:
            for path, content in _WRITERS[project](subject):
                check_inside(path, captures.root)
                if not path.exists():
                    write_atomically(path, content)
        yield name


def _nerf(subject: Subject) -> Iterator[tuple[Path, str]]:
    """The transforms.json of each frame, for instant-ngp and nerfstudio."""
    first = subject.views[0]
    angle = 2 * float(np.arctan(first.width / (2 * first.intrinsics[0, 0])))
    for frame in range(subject.frames):
        path = subject.folder / "nerf" / f"{frame:04d}" / "transforms.json"
        frames = []
        for camera, view in enumerate(subject.views):
            matrix, k = np.eye(4), view.intrinsics
            matrix[:3, :3], matrix[:3, 3] = view.rotation.T @ _FROM_OPENGL, view.position
            picture = os.path.relpath(picture_path(subject.folder, "img", camera, frame), path.parent)
            frames.append(
                {
                    "file_path": Path(picture).as_posix(),
                    "transform_matrix": matrix.tolist(),
                    **{"fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]},
                    **{"w": view.width, "h": view.height},
                }
            )
        yield path, json.dumps({"camera_model": "OPENCV", "camera_angle_x": angle, "frames": frames}, indent=1)


def _opencv(subject: Subject) -> Iterator[tuple[Path, bytes]]:
    views = subject.views
    yield (
        subject.folder / "opencv" / "cameras.npz",
        npz_bytes(
            K=np.stack([view.intrinsics for view in views]),
            R=np.stack([view.rotation for view in views]),
            T=np.stack([view.translation for view in views]),
            width=np.array([view.width for view in views]),
            height=np.array([view.height for view in views]),
        ),
    )


def _colmap(subject: Subject) -> Iterator[tuple[Path, str]]:
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    poses = []
    for number, view in enumerate(subject.views, start=1):
        k, (x, y, z, w) = view.intrinsics, Rotation.from_matrix(view.rotation).as_quat(canonical=True)
        size = f"{view.width} {view.height}"
        cameras.append(f"{number} PINHOLE {size} {k[0, 0]:.17g} {k[1, 1]:.17g} {k[0, 2]:.17g} {k[1, 2]:.17g}")
        poses.append(" ".join(f"{value:.17g}" for value in (w, x, y, z, *view.translation)))
    for frame in range(subject.frames):
        images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, ID, NAME"]
        for number, pose in enumerate(poses, start=1):
            picture = picture_path(subject.folder, "img", number - 1, frame).relative_to(subject.folder / "img")
            images += [f"{number} {pose} {number} {picture.as_posix()}", ""]
        files = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": ["# no points"]}
        for name, lines in files.items():
            yield subject.folder / "colmap" / f"{frame:04d}" / name, "\n".join(lines) + "\n"


_WRITERS = {"nerf": _nerf, "opencv": _opencv, "colmap": _colmap}
