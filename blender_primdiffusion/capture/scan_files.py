"""Scans on disk: which files of a folder are people, by what names they go, and where their parameters are."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import struct
from collections.abc import Iterator
from pathlib import Path

ENDINGS = (".glb", ".gltf", ".fbx", ".obj")
"""Files that hold a person; of several with one name in a folder the first of these counts."""
_GENERIC = {"person", "model", "scan", "mesh", "scene", "body", "human", "untitled", "object"}
"""Names that say nothing: the folder's name serves."""
_RELEASED = ("outputs_re_fitting/refit_smpl_2nd_plain.npz", "refit_smpl_2nd_plain.npz")
_LARGEST_JSON = 64 * 2**20


class ScanError(ValueError):
    """A scan that cannot be used; one sentence: what is wrong, what was given, what to do."""


@dataclasses.dataclass(frozen=True)
class ScanFile:
    """One person on disk."""

    name: str
    """The subject's: `[A-Za-z0-9._-]+`, not starting with a dot, unlike the others'."""
    path: Path
    """The .glb, .gltf, .fbx or .obj."""
    parameters: Path | None
    """The .npz of SMPL parameters beside it, where there is one."""


def find_scans(folder: Path | str) -> list[ScanFile]:
    """The people in a folder and its folders, sorted by path; or the one that a file is.

    Hidden folders are left out. Raises ScanError where the folder is missing or holds nobody.
    """
    folder = Path(folder)
    if folder.is_file():
        if folder.suffix.lower() not in ENDINGS:
            raise ScanError(f"{folder} is no scan: give a .glb, .gltf, .fbx or .obj, or a folder of them")
        return [ScanFile(_slug(folder), folder, _parameters(folder))]
    if not folder.is_dir():
        raise ScanError(f"there is no folder of scans {folder}: check the path")
    chosen: dict[Path, Path] = {}
    for path in _models(folder):
        stem = path.with_suffix("")
        if stem not in chosen or _rank(path) < _rank(chosen[stem]):
            chosen[stem] = path
    if not chosen:
        if any(folder.rglob("*.human*")):
            raise ScanError(
                f"{folder} holds people made of primitives, and captures are made of meshes: export these as .glb "
                "(primdiffusion export), or name a folder of scans"
            )
        raise ScanError(f"{folder} holds no scans: none of its files ends in {', '.join(ENDINGS)}")
    taken: set[str] = set()
    scans = []
    for path in sorted(chosen.values()):
        name, number = _slug(path), 1
        unlike = name
        while unlike.lower() in taken:  # file systems that ignore case must not mix two subjects
            number += 1
            unlike = f"{name}_{number}"
        taken.add(unlike.lower())
        scans.append(ScanFile(unlike, path, _parameters(path)))
    return scans


def own_betas(path: Path) -> tuple[list[float], str] | None:
    """Betas and the body's name that the backend's people carry in their .glb; None in other files."""
    if path.suffix.lower() != ".glb":
        return None
    try:
        with path.open("rb") as stream:
            magic, _, _, length, kind = struct.unpack("<4sIII4s", stream.read(20))
            if magic != b"glTF" or kind != b"JSON" or length > _LARGEST_JSON:
                return None
            content = json.loads(stream.read(length))
        for holder in (content.get("asset", {}), *content.get("scenes", [])):
            about = (holder.get("extras") or {}).get("primdiffusion")
            if about:
                return [float(beta) for beta in about["betas"]], str(about.get("body", "default"))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, struct.error, RecursionError):
        return None
    return None


def _models(folder: Path) -> Iterator[Path]:
    """Files of scans, sorted; linked folders are gone into, each folder once."""
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
    stem = path.stem if path.stem.lower() not in _GENERIC else path.resolve().parent.name
    return re.sub(r"[^A-Za-z0-9._-]+", "_", stem).strip("_.") or "person"


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
