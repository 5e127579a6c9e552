"""SMPL parameters beside a static scan: which body, in which pose, the person on it is."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..formats.arrays import ArrayFileError, array_names, read_arrays
from ..motion.files import POSE_KEYS, MotionFileError, motion_from_arrays
from .scan_files import ScanError, ScanFile

_SHAPE_KEYS = ("betas", "shape", "beta")


@dataclasses.dataclass(frozen=True, eq=False)
class Parameters:
    """A posed body: x = scale * body(betas, rotations) + translation."""

    betas: NDArray[np.float64]
    """[n]."""
    rotations: NDArray[np.float64]
    """[24, 3, 3]."""
    translation: NDArray[np.float64]
    """[3], the scan's units."""
    scale: float
    body: str
    """Name of the body that the betas are of; empty where the file does not tell."""
    notes: list[str]


def read_parameters(scan_file: ScanFile) -> Parameters:
    """The parameters of a scan; of several frames the first.

    The .npz of plain arrays has `global_orient` and `body_pose` (or `pose`, `poses`), `betas`, and if wanted `transl`
    or `trans`, `scale`, and `body`, the name of the body whose shape `betas` are. Raises ScanError where it is missing
    or holds something else.
    """
    path = scan_file.parameters
    if path is None:
        pickled = [e for e in (".pkl", ".pickle") if scan_file.path.with_suffix(e).is_file()]
        hint = "; pickles are never read, save it as .npz of plain arrays" if pickled else ""
        raise ScanError(
            f"{scan_file.path} has no skeleton, and no SMPL parameters are beside it: put {scan_file.path.stem}.npz "
            f"with global_orient, body_pose, betas and transl there{hint}"
        )
    try:
        arrays = read_arrays(path, optional=(*POSE_KEYS, *_SHAPE_KEYS, "scale", "body"))
        motion = motion_from_arrays({key: arrays[key] for key in POSE_KEYS if key in arrays}, path)
    except (ArrayFileError, MotionFileError, OSError) as e:
        raise ScanError(str(e)) from e
    except StopIteration:
        names = ", ".join(array_names(path)[:8])
        raise ScanError(f"{path} holds no pose ({names}): it needs global_orient and body_pose, or pose") from None
    betas = next((arrays[key] for key in _SHAPE_KEYS if key in arrays), np.zeros(10))
    scale = arrays.get("scale", np.ones(1))
    return Parameters(
        betas=_row(betas, path, "betas"),
        rotations=motion.rotations[0],
        translation=motion.translations[0],
        scale=_positive(scale, path),
        body=str(arrays["body"].ravel()[0]) if arrays.get("body", np.zeros(0)).size == 1 else "",
        notes=[f"first of {len(motion)} frames of parameters"] if len(motion) > 1 else [],
    )


def _row(values: NDArray, path: Path, name: str) -> NDArray[np.float64]:
    if values.dtype.kind not in "iuf" or values.size == 0 or not np.isfinite(values).all():
        raise ScanError(f"{path}: {name!r} holds something else than finite numbers")
    return np.asarray(values, np.float64).reshape(-1, values.shape[-1] if values.ndim else 1)[0]


def _positive(values: NDArray, path: Path) -> float:
    number = float(_row(values, path, "scale")[0])
    if not number > 0:
        raise ScanError(f"{path}: 'scale' is {number:g}, not positive")
    return number
