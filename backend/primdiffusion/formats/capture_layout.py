"""Captures on disk: the folders of the released code (SPEC 5), plus passes, joints and camera files of other projects.

    root/dataset.json                              what the captures are: settings, axes, passes, names of parts
    root/release_human_list.txt                    one subject a line
    root/annotations.json, root/images.csv         COCO annotations and a table of images: `captures coco`
    root/composed/{id}/img/cameraNNNN/FFFF.jpg     of it: over backgrounds, or of several humans
    root/{id}/img/cameraNNNN/FFFF.jpg              sRGB over the background
    root/{id}/mask/cameraNNNN/FFFF.png             8 bits: share of the pixel that the person covers
    root/{id}/depth/cameraNNNN/FFFF.png            16 bits, in units of 0.25 mm along the optical axis; 0: nothing
    root/{id}/depth_float/cameraNNNN/FFFF.exr      metres along the optical axis, float32; 0: nothing; only if asked for
    root/{id}/normal/cameraNNNN/FFFF.png           8 bits: (world normal + 1) / 2; 0, 0, 0: nothing
    root/{id}/part/cameraNNNN/FFFF.png             8 bits: 1 + the joint that moves the surface most; 0: nothing
    root/{id}/rgba/cameraNNNN/FFFF.png             sRGB with straight alpha; only where the background is transparent
    root/{id}/hdri/cameraNNNN/FFFF.jpg             sRGB over the environment of the HDRI; only with that background
    root/{id}/cameras.json                         {"camera0000": {"K": 3x3, "R": 3x3, "T": [3]}, ...}
    root/{id}/joints.npz                           world [F,24,3], pixel [C,F,24,2], depth [C,F,24], fitted
    root/{id}/outputs_re_fitting/refit_smpl_2nd.npz        "smpl": the released code's pickled dictionary
    root/{id}/outputs_re_fitting/refit_smpl_2nd_plain.npz  the same as plain arrays: read this one
    root/{id}/nerf/FFFF/transforms.json            camera to world, OpenGL axes; one static scene a frame
    root/{id}/opencv/cameras.npz                   K [C,3,3], R [C,3,3], T [C,3], width, height
    root/{id}/colmap/FFFF/{cameras,images,points3D}.txt    picture names relative to root/{id}/img
    root/{id}/complete.json                        every file's size and CRC-32: written last

World: metres, y up, the person faces +z. Files are written under a temporary name, then renamed; several processes may
write different subjects, or views, of one dataset. `picture_files` writes pictures.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..files.arrays import read_numbers
from ..files.json_files import parse_json, read_json
from ..files.regular_files import FileError, check_inside, open_regular, read_regular, remove_file
from ..files.whole_files import remove_abandoned, temporary_name, write_atomically
from .camera_rig import View
from .requests import LAYOUTS

FORMAT, VERSION = "primdiffusion-captures", 1
ENDINGS = {
    "img": ".jpg", "mask": ".png", "depth": ".png", "depth_float": ".exr", "normal": ".png", "part": ".png",
    "rgba": ".png", "hdri": ".jpg",
}  # fmt: skip
"""File extensions of passes."""
SMPL_FOLDER, SMPL_FILE, SMPL_PLAIN_FILE = "outputs_re_fitting", "refit_smpl_2nd.npz", "refit_smpl_2nd_plain.npz"
RELEASED_REFERENCE = "seq_000016-rp_alison_rigged_002"
"""Name of the subject that determines the rest sizes of primitives in the released code."""
LIST_FILE, DATASET_FILE, COMPLETE_FILE = "release_human_list.txt", "dataset.json", "complete.json"
LARGEST_FILE, LARGEST_LIST = 512 * 2**20, 32 * 2**20
"""Bytes of a file of a subject, and of the list of subjects."""
_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])


def picture_path(subject: Path, kind: str, camera: int, frame: int) -> Path:
    """Return the path of an image of pass `kind`."""
    return subject / kind / f"camera{camera:04d}" / f"{frame:04d}{ENDINGS[kind]}"


def view_seed(seed: int, subject: str, frame: int, camera: int) -> int:
    """Return the noise seed of an image, 0 ... 2^31 - 1, independent of the order of rendering."""
    digest = hashlib.sha256(f"{seed}/{subject}/{frame}/{camera}".encode()).digest()
    return int.from_bytes(digest[:4], "big") >> 1


def write_npz(path: Path, **arrays: NDArray) -> None:
    """Write an .npz atomically, built in memory: numpy's writer leaves an open archive behind if the disk is full."""
    made = io.BytesIO()
    np.savez(made, **arrays)  # type: ignore[arg-type]
    write_atomically(path, made.getvalue())


def claim(root: Path, about: Mapping[str, Any]) -> None:
    """Create the dataset `root` with the settings `about`, or check that an existing one has the same.

    Raises FileError if the folder contains another dataset or other files.
    """
    wanted = {"format": FORMAT, "version": VERSION, **parse_json(json.dumps(about))}
    remove_abandoned(root, root / DATASET_FILE)
    if not (root / DATASET_FILE).exists():
        if root.is_dir() and any(not path.name.startswith(".") for path in root.iterdir()):
            reason = f"is not empty and holds no {DATASET_FILE}"
            raise FileError(root, reason, "choose a new folder for the captures")
        root.mkdir(parents=True, exist_ok=True)
        unlike = temporary_name(root / DATASET_FILE)
        try:  # a link fails where another process was first, which a rename would not
            unlike.write_text(json.dumps(wanted, indent=1), encoding="utf-8", newline="\n")
            try:
                os.link(unlike, root / DATASET_FILE)
            except FileExistsError:
                pass
            except OSError:  # a disk without links: exFAT, some network folders
                os.replace(unlike, root / DATASET_FILE)
        except OSError as e:
            raise type(e)(e.errno, e.strerror or str(e), str(root / DATASET_FILE)) from e
        finally:
            remove_file(unlike, root)
    present = read_about(root)
    differing = [key for key in {**present, **wanted} if present.get(key) != wanted.get(key)]
    if differing:
        key = differing[0]
        raise FileError(
            root,
            f"holds captures whose {key:.40} is {present.get(key)!r:.60}, not {wanted.get(key)!r:.60}",
            "choose another folder, or the same settings",
        )


def read_about(root: Path) -> dict[str, Any]:
    """Read the settings of a dataset. Raises FileError if they are missing or damaged."""
    try:
        about = read_json(root / DATASET_FILE)
    except FileNotFoundError:
        raise FileError(root, f"holds no captures (no {DATASET_FILE})", "choose a folder of captures") from None
    except (OSError, ValueError) as e:
        raise FileError(root / DATASET_FILE, f"cannot be read ({e!s:.160})", "render the captures again") from e
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise FileError(root / DATASET_FILE, f"is not the {DATASET_FILE} of captures", "choose another folder")
    if about.get("version") != VERSION:
        reason = f"is of version {about.get('version')!s:.20}, not {VERSION}"
        raise FileError(root, reason, "use the matching release, or render the captures again")
    return about


def read_list(root: Path) -> list[str]:
    """Return the names in the list of finished subjects; none without one. Raises as `read_regular`."""
    try:
        text = read_regular(root / LIST_FILE, LARGEST_LIST).decode("utf-8", "replace")
    except FileNotFoundError:
        return []
    return [name for line in text.splitlines() if (name := line.strip())]


def write_list(root: Path, subjects: Sequence[str]) -> None:
    """Write the sorted list of subjects."""
    write_atomically(root / LIST_FILE, "".join(f"{name}\n" for name in sorted(subjects)))


def write_smpl(subject: Path, global_orient: NDArray, body_pose: NDArray, betas: NDArray, translation: NDArray) -> None:
    """Write SMPL parameters: axis-angle [F,3] and [F,69], betas [B], metres [F,3]; frame 0 is the near-T pose.

    Raises FileError if the folder holds those of another human, or other poses.
    """
    arrays = {
        "global_orient": np.asarray(global_orient, np.float32),
        "body_pose": np.asarray(body_pose, np.float32),
        "betas": np.asarray(betas, np.float32).reshape(1, -1),
        "transl": np.asarray(translation, np.float32),
    }
    _check_same_smpl(subject, arrays)
    write_npz(subject / SMPL_FOLDER / SMPL_PLAIN_FILE, **arrays)
    write_npz(subject / SMPL_FOLDER / SMPL_FILE, smpl=np.array(arrays, dtype=object))


def write_joints(subject: Path, views: Sequence[View], world: NDArray, fitted: NDArray | None = None) -> None:
    """Write the joints [F,24,3] in the world and in every image.

    `fitted` are those of the body whose betas are stored, where the subject has a rig of its own: they tell which body
    that is, while the heads of other rigs' bones are centimetres from any body's joints.
    """
    projected = [view.project(world) for view in views]
    write_npz(
        subject / "joints.npz",
        world=np.asarray(world, np.float32),
        **({} if fitted is None else {"fitted": np.asarray(fitted, np.float32)}),
        pixel=np.stack([pixel for pixel, _ in projected]).astype(np.float32),
        depth=np.stack([depth for _, depth in projected]).astype(np.float32),
    )


def complete(subject: Path) -> None:
    """Record size and checksum of every file of a finished subject, and remove partial files of killed processes.

    Call it once, after all writing to the subject has ended.
    """
    for partial in subject.rglob(".*.partial.*"):
        remove_file(partial, subject)
    files = {
        path.relative_to(subject).as_posix(): [path.stat().st_size, _crc(path)]
        for path in sorted(subject.rglob("*"))
        if path.is_file() and not path.name.startswith(".") and path.name != COMPLETE_FILE
    }
    write_atomically(subject / COMPLETE_FILE, json.dumps(files, indent=0))


def damage(subject: Path, *, checksums: bool = True) -> dict[Path, str]:
    """Return what is wrong with each damaged file of a finished subject, or with the folder of an unfinished one.

    An unfinished subject has no readable complete.json. Without `checksums` only sizes are compared. Never names a
    file outside of the subject.
    """
    try:
        files = read_json(subject / COMPLETE_FILE)
        noted = {_inside(subject, name): (size, crc) for name, (size, crc) in files.items()}
        if not all(type(number) is int for numbers in noted.values() for number in numbers):
            raise TypeError("a size or a checksum is no integer")
    except (OSError, ValueError, AttributeError, TypeError):
        return {subject: "not finished"}
    wrong = {}
    for path, (size, crc) in noted.items():
        if not path.is_file():
            wrong[path] = "missing"
        elif path.stat().st_size != size:
            wrong[path] = f"{path.stat().st_size} bytes instead of {size}"
        elif size > LARGEST_FILE:
            wrong[path] = f"larger than {LARGEST_FILE // 2**20} MB"
        elif checksums and _crc(path) != crc:
            wrong[path] = "altered"
    return wrong


def _check_same_smpl(subject: Path, wanted: Mapping[str, NDArray]) -> None:
    try:
        present = read_numbers(subject / SMPL_FOLDER / SMPL_PLAIN_FILE, tuple(wanted))
    except (FileNotFoundError, FileError):
        return  # missing or truncated: it is written again
    for name, values in wanted.items():
        if present[name].shape != values.shape or not np.allclose(present[name], values, atol=1e-5):
            reason = f"holds another human or other poses ({name} differs)"
            raise FileError(subject, reason, "choose another folder, or remove it")


def _inside(subject: Path, name: str) -> Path:
    if Path(name).is_absolute() or ".." in Path(name).parts or "\\" in name or not name.isprintable():
        raise ValueError(f"{name!r} is no file of {subject}")
    check_inside(subject / name, subject)
    return subject / name


def _crc(path: Path) -> int:
    """Raises as `open_regular`."""
    crc = 0
    with open_regular(path, LARGEST_FILE) as file:
        while chunk := file.read(1 << 20):
            crc = zlib.crc32(chunk, crc)
    return crc


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
