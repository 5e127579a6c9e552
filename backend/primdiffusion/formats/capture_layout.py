"""Captures on disk: the folders of the released code (SPEC 5), plus passes and joints.

    root/dataset.json                              what the captures are: settings, axes, passes, names of parts
    root/release_human_list.txt                    one subject a line
    root/annotations.json                          COCO annotations: `captures coco`
    root/composed/{id}/img/cameraNNNN/FFFF.jpg     of it: of several humans
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
    root/{id}/nerf, opencv, colmap                 cameras for other projects: `captures export`
    root/{id}/complete.json                        written last: a subject that has it is finished

World: metres, y up, the person faces +z. Files are written under a temporary name, then renamed; several processes may
write different subjects, or views, of one dataset. `picture_files` writes pictures.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..files.arrays import all_finite, read_numbers
from ..files.json_files import parse_json, read_json
from ..files.regular_files import FileError, as_file_error, read_regular, remove_file
from ..files.whole_files import write_atomically
from .camera_rig import View

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
LARGEST_LIST = 32 * 2**20
"""Largest list of subjects, bytes."""


def picture_path(subject: Path, kind: str, camera: int, frame: int) -> Path:
    """Return the path of an image of pass `kind`."""
    return subject / kind / f"camera{camera:04d}" / f"{frame:04d}{ENDINGS[kind]}"


def view_seed(seed: int, subject: str, frame: int, camera: int) -> int:
    """Return the noise seed of an image, 0 ... 2^31 - 1, independent of the order of rendering."""
    digest = hashlib.sha256(f"{seed}/{subject}/{frame}/{camera}".encode()).digest()
    return int.from_bytes(digest[:4], "big") >> 1


def npz_bytes(**arrays: NDArray) -> bytes:
    """Content of an .npz, built in memory: numpy's writer leaves an open archive behind if the disk is full."""
    made = io.BytesIO()
    np.savez(made, **arrays)  # type: ignore[arg-type]
    return made.getvalue()


def write_npz(path: Path, **arrays: NDArray) -> None:
    """Write an .npz atomically."""
    write_atomically(path, npz_bytes(**arrays))


def claim(root: Path, about: Mapping[str, Any]) -> None:
    """Create the dataset `root` with the settings `about`, or check that an existing one has the same.

    Raises FileError if the folder contains another dataset or other files.
    """
    wanted = {"format": FORMAT, "version": VERSION, **parse_json(json.dumps(about))}
    if not (root / DATASET_FILE).exists():
        if root.is_dir() and any(not path.name.startswith(".") for path in root.iterdir()):
            reason = f"is not empty and holds no {DATASET_FILE}"
            raise FileError(root, reason, "choose a new folder for the captures")
        write_atomically(root / DATASET_FILE, json.dumps(wanted, indent=1))
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


def list_subjects(root: Path) -> None:
    """Write the sorted list of finished subjects, without the released code's reference, which repeats one."""
    names = sorted(path.parent.name for path in root.glob(f"*/{COMPLETE_FILE}"))
    listed = [name for name in names if not name.startswith(".") and name != RELEASED_REFERENCE]
    write_atomically(root / LIST_FILE, "".join(f"{name}\n" for name in listed))


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
    """Mark a subject as finished, and remove partial files of killed processes.

    Call it once, after all writing to the subject has ended.
    """
    for partial in subject.rglob(".*.partial.*"):
        remove_file(partial, subject)
    write_atomically(subject / COMPLETE_FILE, "{}\n")


def is_complete(subject: Path) -> bool:
    """Whether a subject is finished."""
    return (subject / COMPLETE_FILE).is_file()


def is_complete_view(subject: Path, passes: Sequence[str], camera: int, frame: int) -> bool:
    """Whether all images of a view exist: files appear whole or not at all."""
    return all(picture_path(subject, kind, camera, frame).is_file() for kind in passes)


def _check_same_smpl(subject: Path, wanted: Mapping[str, NDArray]) -> None:
    try:
        present = read_numbers(subject / SMPL_FOLDER / SMPL_PLAIN_FILE, tuple(wanted))
    except (FileNotFoundError, FileError):
        return  # missing or truncated: it is written again
    for name, values in wanted.items():
        if present[name].shape != values.shape or not np.allclose(present[name], values, atol=1e-5):
            reason = f"holds another human or other poses ({name} differs)"
            raise FileError(subject, reason, "choose another folder, or remove it")


def write_cameras(subject: Path, views: Sequence[View]) -> None:
    """Write cameras.json for the released code."""
    named = {
        f"camera{i:04d}": {"K": v.intrinsics.tolist(), "R": v.rotation.tolist(), "T": v.translation.tolist()}
        for i, v in enumerate(views)
    }
    write_atomically(subject / "cameras.json", json.dumps(named, indent=1))


def views_in(named: Any, path: Path, size: Callable[[int], tuple[int, int]]) -> list[View]:
    """The cameras of {"camera0000": {"K": 3x3, "R": 3x3, "T": [3]}, ...}; `size` gives width and height by number.

    Raises FileError, which names `path`, and what `size` raises.
    """
    views = []
    for number in range(len(named) if isinstance(named, dict) else 0):
        name = f"camera{number:04d}"
        with as_file_error(path, f"has no camera in {name}", "render the captures again"):
            k, r, t = (np.asarray(named[name][key], np.float64) for key in "KRT")
            if (k.shape, r.shape, t.size) != ((3, 3), (3, 3), 3) or not all(map(all_finite, (k, r, t))):
                raise ValueError("it is not finite, or its shapes are not K 3x3, R 3x3, T 3")
            views.append(View(k, r, t.reshape(3), *size(number)))
    if not views:
        raise FileError(path, "contains no camera", "render the captures again")
    return views
