"""A body loaded from the user's own files and the anchors on it, used in place of the default body.

The license of such a body may not allow redistribution, so our files store its path and hash, never its data.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Iterable
from pathlib import Path, PureWindowsPath

from jaxtyping import Float
from torch import Tensor

from primdiffusion.body.model import BodyModel
from primdiffusion.body.smpl_files import LARGEST_BODY_FILE, load_body
from primdiffusion.files.json_files import parse_json
from primdiffusion.files.regular_files import FileError, check_regular, is_local_path, open_regular, real_path
from primdiffusion.formats.schema import read
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.anchors import Anchors, build_anchors
from primdiffusion.primitives.primitives import K


@dataclasses.dataclass(frozen=True)
class FileFingerprint:
    """Path and content hash of a user's file."""

    path: str
    sha256: str

    @classmethod
    def of(cls, path: Path) -> FileFingerprint:
        """Path and hash of a file. Raises FileError, OSError."""
        return cls(str(real_path(path)), _sha256(path))


@dataclasses.dataclass(frozen=True)
class BodyFiles:
    """The user's files from which a body and its anchors (rule "released", SPEC 1.2) are loaded."""

    smpl: FileFingerprint
    uv: tuple[FileFingerprint, ...]
    """Files of texture coordinates: one .obj or .npz, or the pair vt.npy and ft.npy."""

    def to_json(self) -> str:
        """Serialise to JSON for file metadata."""
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str) -> BodyFiles:
        """Parse the result of `to_json`; ValueError if malformed."""
        try:
            return read(cls, parse_json(text))
        except ValueError as error:
            raise ValueError(f"malformed body metadata ({error!s:.100})") from error


@dataclasses.dataclass(frozen=True)
class BodySetup(TensorRecord):
    """A body and its anchors."""

    body: BodyModel
    anchors: Anchors
    files: BodyFiles


def body_setup_from_files(smpl: Path, uv: tuple[Path, ...]) -> BodySetup:
    """Load a body and build its anchors; rest extents are those of the template in the T pose.

    Raises OSError and the errors of `load_body`.
    """
    if not 1 <= len(uv) <= 2:
        raise FileError(smpl, f"has {len(uv)} files of texture coordinates", "give 1 or 2")
    body = load_body(smpl, uv=uv[0] if len(uv) == 1 else (uv[0], uv[1]))
    files = BodyFiles(FileFingerprint.of(smpl), tuple(map(FileFingerprint.of, uv)))
    return BodySetup(body, build_anchors(body, "released"), files)


def find_body_setup(files: BodyFiles, rest_half_extent: Float[Tensor, "k 3"], beside: Iterable[Path]) -> BodySetup:
    """Load the body that a checkpoint or human refers to, with the rest extents stored there.

    Each file is searched at its recorded path, then by name in the folders `beside`; the content hash must match.
    Raises FileError for a body file that is missing, changed or damaged, and ValueError for impossible rest extents.
    """
    folders, wanted = tuple(beside), (files.smpl, *files.uv)
    paths = [_found(file, folders) for file in wanted]
    body_setup = _body_setup(tuple(paths), tuple(file.sha256 for file in wanted))
    if tuple(rest_half_extent.shape) != (K, 3) or not bool((rest_half_extent > 0).all()):
        raise ValueError(f"the stored rest extents are not {K} x 3 positive")
    return dataclasses.replace(
        body_setup, anchors=dataclasses.replace(body_setup.anchors, rest_half_extent=rest_half_extent), files=files
    )


@functools.lru_cache(maxsize=2)
def _body_setup(paths: tuple[Path, ...], hashes: tuple[str, ...]) -> BodySetup:
    """Load the body of files with these hashes."""
    return body_setup_from_files(paths[0], paths[1:])


def _found(file: FileFingerprint, folders: tuple[Path, ...]) -> Path:
    shown, name = f"{file.path!r:.120}".strip("'"), PureWindowsPath(file.path).name  # also parses POSIX paths
    named = [Path(file.path)] if is_local_path(file.path) else []
    problem = "is missing" if named else "is not named by a path on this machine"
    for path in (*named, *(folder / name for folder in folders if name)):
        try:
            status = check_regular(path)
            digest = _known_sha256(path, status.st_mtime_ns, status.st_size)
        except (FileNotFoundError, NotADirectoryError):
            continue
        except (OSError, FileError) as error:
            problem = f"cannot be read ({getattr(error, 'strerror', None) or getattr(error, 'reason', '')})"
            continue
        if digest == file.sha256:
            return path
        shown, problem = f"{path!s:.120}", "has changed"
    if problem == "has changed":
        reason = f"has changed (a body file, sha256 was {file.sha256[:12]}...)"
        raise FileError(shown, reason, "restore it, or import the checkpoint again with this file")
    reason = f"{problem} (a body file, sha256 {file.sha256[:12]}...)"
    raise FileError(shown, reason, "restore it, or put a copy beside the file that refers to it")


@functools.lru_cache(maxsize=16)
def _known_sha256(path: Path, nanoseconds: int, size: int) -> str:
    return _sha256(path)


def _sha256(path: Path) -> str:
    with open_regular(path, LARGEST_BODY_FILE) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
