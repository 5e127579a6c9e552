"""Scans on disk: which files of a folder are humans, their import, and the SMPL parameters beside them."""

from __future__ import annotations

import dataclasses
import os
import re
import struct
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..files.arrays import all_finite, read_arrays
from ..files.json_files import parse_json
from ..files.regular_files import FileError, open_regular, portable_name, real_path
from ..formats.poses.files import POSE_KEYS, motion_from_arrays

ENDINGS = (".glb", ".gltf", ".fbx", ".obj")
"""Files of scans; of several with the same name in a folder, the first of these is used."""
_GENERIC = {"person", "model", "scan", "mesh", "scene", "body", "human", "untitled", "object"}
"""Generic names: the folder's name is used instead."""
_RELEASED = ("outputs_re_fitting/refit_smpl_2nd_plain.npz", "refit_smpl_2nd_plain.npz")
_LARGEST_JSON, _LARGEST_SCAN = 64 * 2**20, 2**40
"""Bytes; the importers of Blender read the scans."""


@dataclasses.dataclass(frozen=True)
class ScanFile:
    """One human on disk."""

    name: str
    """Name of the subject: unique, `[A-Za-z0-9._-]+`, not starting with a dot or a hyphen."""
    path: Path
    """The .glb, .gltf, .fbx or .obj."""
    parameters: Path | None
    """The .npz of SMPL parameters beside it, where there is one."""


def find_scans(folder: Path | str) -> list[ScanFile]:
    """The scans in a folder and below, sorted by path; or the one in a file.

    Hidden folders are left out. Raises FileError where the folder is missing or holds no scan.
    """
    folder = Path(folder)
    if folder.is_file():
        if folder.suffix.lower() not in ENDINGS:
            raise FileError(folder, "is not a scan", "give a .glb, .gltf, .fbx or .obj, or a folder of them")
        return [ScanFile(_slug(folder), folder, _parameters(folder))]
    if not folder.is_dir():
        raise FileError(folder, "does not exist", "check the path of the scans")
    chosen: dict[Path, Path] = {}
    for path in _models(folder):
        stem = path.with_suffix("")
        if stem not in chosen or _rank(path) < _rank(chosen[stem]):
            chosen[stem] = path
    if not chosen:
        if any(folder.rglob("*.human*")):
            reason = "holds people made of primitives, and captures are made of meshes"
            raise FileError(folder, reason, "export these as .glb (primdiffusion export), or name a folder of scans")
        raise FileError(folder, "holds no scans", f"give a folder of files that end in {', '.join(ENDINGS)}")
    taken: set[str] = set()
    scans = []
    for path in sorted(chosen.values()):
        name, number = _slug(path), 1
        unlike = name
        while unlike.lower() in taken:  # some file systems ignore case
            number += 1
            unlike = f"{name}_{number}"
        taken.add(unlike.lower())
        scans.append(ScanFile(unlike, path, _parameters(path)))
    return scans


def own_betas(path: Path) -> tuple[list[float], str] | None:
    """Betas and the name of the body, which the backend writes into its .glb files; None for other files."""
    if path.suffix.lower() != ".glb":
        return None
    try:
        with open_regular(path, _LARGEST_SCAN) as stream:
            magic, _, _, length, kind = struct.unpack("<4sIII4s", stream.read(20))
            if magic != b"glTF" or kind != b"JSON" or length > _LARGEST_JSON:
                return None
            content = parse_json(stream.read(length))
        for holder in (content.get("asset", {}), *content.get("scenes", [])):
            about = (holder.get("extras") or {}).get("primdiffusion")
            if about:
                return [float(beta) for beta in about["betas"]], str(about.get("body", "default"))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, struct.error):
        return None
    return None


def _models(folder: Path) -> Iterator[Path]:
    """Files of scans, sorted; follows linked folders, each folder once."""
    entered = set()
    for inner, folders, names in os.walk(folder, followlinks=True):
        if os.path.realpath(inner) in entered:
            folders.clear()
            continue
        entered.add(os.path.realpath(inner))
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            path = Path(inner, name)
            if path.suffix.lower() in ENDINGS and path.is_file() and not name.startswith("."):
                yield path


def _rank(path: Path) -> int:
    return ENDINGS.index(path.suffix.lower())


def _slug(path: Path) -> str:
    stem = path.stem if path.stem.lower() not in _GENERIC else real_path(path).parent.name
    return portable_name(re.sub(r"[^A-Za-z0-9._-]+", "_", stem).strip("_.-")) or "person"


def _parameters(path: Path) -> Path | None:
    """SMPL parameters of a scan: of the same name, in the released folder, or the only .npz beside the only scan."""
    same = path.with_suffix(".npz")
    if same.is_file():
        return same
    for relative in _RELEASED:
        if (path.parent / relative).is_file():
            return path.parent / relative
    beside = [other for other in path.parent.iterdir() if other.suffix.lower() == ".npz"]
    models = {other.stem for other in path.parent.iterdir() if other.suffix.lower() in ENDINGS}
    return beside[0] if len(beside) == 1 and len(models) == 1 else None


def import_file(path: Path) -> list[bpy.types.Object]:
    """Import a .glb, .gltf, .fbx or .obj into the scene; its objects. Raises FileError where Blender cannot read it."""
    if not path.is_file():
        raise FileError(path, "does not exist", "check the path of the scan")
    before = {obj.session_uid for obj in bpy.data.objects}
    importers = {".glb": _import_gltf, ".gltf": _import_gltf, ".fbx": _import_fbx, ".obj": _import_obj}
    try:
        importers[path.suffix.lower()](str(path))
    except Exception as e:  # Python importers raise anything on damaged files
        raise FileError(path, f"cannot be imported ({_last_line(e)})", "export it again") from e
    return [obj for obj in bpy.data.objects if obj.session_uid not in before]


def _import_gltf(path: str) -> None:
    bpy.ops.import_scene.gltf(filepath=path, disable_bone_shape=True, bone_heuristic="BLENDER")


def _import_fbx(path: str) -> None:
    try:
        bpy.ops.wm.fbx_import(filepath=path, use_anim=False)
    except RuntimeError:  # the older importer reads some files that the newer one rejects
        bpy.ops.import_scene.fbx(filepath=path, use_anim=False)


def _import_obj(path: str) -> None:
    bpy.ops.wm.obj_import(filepath=path)


def _last_line(error: Exception) -> str:
    """The exception at the end of an importer's traceback, without Blender's location."""
    lines = [line.strip() for line in str(error).splitlines()]
    lines = [line for line in lines if line and not line.startswith("Location: ")]
    return (lines[-1] if lines else type(error).__name__).removeprefix("Error: ")


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
    """Name of the body that the betas belong to; empty where the file does not state it."""
    notes: list[str]


def read_parameters(scan_file: ScanFile) -> Parameters:
    """The parameters of a scan; of several frames the first.

    The .npz of plain arrays has `global_orient` and `body_pose` (or `pose`, `poses`), `betas`, and if wanted `transl`
    or `trans`, `scale`, and `body`, the name of the body whose shape `betas` are. Raises FileError where it is missing
    or holds something else.
    """
    path = scan_file.parameters
    if path is None:
        pickled = [e for e in (".pkl", ".pickle") if scan_file.path.with_suffix(e).is_file()]
        hint = f"; {pickled[0]} beside it is not read, save it as .npz of plain arrays" if pickled else ""
        raise FileError(
            scan_file.path,
            "has no skeleton, and no SMPL parameters are beside it",
            f"put {scan_file.path.stem}.npz with global_orient, body_pose, betas and transl there{hint}",
        )
    try:
        arrays = read_arrays(path, optional=(*POSE_KEYS, *_SHAPE_KEYS, "scale", "body"))
        motion = motion_from_arrays({key: arrays[key] for key in POSE_KEYS if key in arrays}, path)
    except OSError as e:
        raise FileError(path, f"cannot be read ({e.strerror or e})", "check that it may be opened") from e
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
    if values.dtype.kind not in "iuf" or values.size == 0 or not all_finite(values):
        raise FileError(path, f"holds something else than finite numbers in {name!r}", "save it as numbers")
    return np.asarray(values, np.float64).reshape(-1, values.shape[-1] if values.ndim else 1)[0]


def _positive(values: NDArray, path: Path) -> float:
    number = float(_row(values, path, "scale")[0])
    if not number > 0:
        raise FileError(path, f"has a 'scale' of {number:g}", "give a positive scale, or none")
    return number
