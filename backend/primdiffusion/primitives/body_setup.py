"""What a person's primitives stand on where it is not the default body: a body of the user's own files.

Such bodies may be licensed to the user alone, so files that need one hold paths and fingerprints, never its data.
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
from primdiffusion.body.smpl_files import load_body
from primdiffusion.geometry.records import TensorRecord
from primdiffusion.primitives.anchors import Anchors, build_anchors
from primdiffusion.primitives.primitives import K


class BodySetupError(ValueError):
    """A body that a file needs is not there, or not the same; the message names it and says what to do."""


@dataclasses.dataclass(frozen=True)
class FileFingerprint:
    """A file of the user's by place and content."""

    path: str
    sha256: str

    @classmethod
    def of(cls, path: Path) -> FileFingerprint:
        """Of a file as it is now. Raises OSError."""
        with open(path, "rb") as file:
            return cls(str(path.resolve()), hashlib.file_digest(file, "sha256").hexdigest())


@dataclasses.dataclass(frozen=True)
class BodyFiles:
    """Which files of the user's a body and its anchors are made from, by the released rule (SPEC 1.2)."""

    smpl: FileFingerprint
    uv: tuple[FileFingerprint, ...]
    """One .obj or .npz, or the pair vt.npy and ft.npy."""

    def to_json(self) -> str:
        """For the metadata of a file."""
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str) -> BodyFiles:
        """The inverse; ValueError for anything else."""
        try:
            tree = json.loads(text)
            return cls(FileFingerprint(**tree["smpl"]), tuple(FileFingerprint(**file) for file in tree["uv"]))
        except (KeyError, TypeError) as error:
            raise ValueError(f"it does not say which body it needs ({type(error).__name__}: {error})") from error


@dataclasses.dataclass(frozen=True)
class BodySetup(TensorRecord):
    """A body and the anchors on it, which go together."""

    body: BodyModel
    anchors: Anchors
    files: BodyFiles


def body_setup_from_files(smpl: Path, uv: tuple[Path, ...]) -> BodySetup:
    """The stand that files make, fingerprinted; rest extents are those of the template in the T pose.

    Raises what `load_body` does, and OSError.
    """
    files = BodyFiles(FileFingerprint.of(smpl), tuple(map(FileFingerprint.of, uv)))
    body = load_body(smpl, uv=uv[0] if len(uv) == 1 else (uv[0], uv[1]))
    return BodySetup(body, build_anchors(body, "released"), files)


def find_body_setup(files: BodyFiles, rest_half_extent: Float[Tensor, "k 3"], beside: Iterable[Path]) -> BodySetup:
    """The stand that another file needs, with the rest extents that this file holds.

    Each file is looked for where it was, then by its name in the folders `beside`; only its content counts.
    Raises BodySetupError where one is nowhere, or has another content; BodyFileError.
    """
    folders = tuple(beside)
    smpl, *uv = (_found(file, folders) for file in (files.smpl, *files.uv))
    body_setup = _loaded(smpl, tuple(uv))
    if tuple(rest_half_extent.shape) != (K, 3) or not bool((rest_half_extent > 0).all()):
        raise BodySetupError(f"the rest extents are no {K} x 3 positive numbers: import or generate it again")
    return dataclasses.replace(
        body_setup, anchors=dataclasses.replace(body_setup.anchors, rest_half_extent=rest_half_extent), files=files
    )


def _found(file: FileFingerprint, folders: tuple[Path, ...]) -> _Stamp:
    name = PureWindowsPath(file.path).name  # of paths of any system
    paths = [Path(file.path), *(folder / name for folder in folders)]
    there = [path for path in paths if path.is_file()]
    for path in there:
        stamp = _Stamp.of(path)
        if _sha256(stamp) == file.sha256:
            return stamp
    if there:
        raise BodySetupError(
            f"{there[0]} is not the body file it was (sha256 {file.sha256[:12]}...): put the same file back, or import "
            "the checkpoint again with this one"
        )
    raise BodySetupError(
        f"the body file {file.path} is not there any more: put it back, or a copy (sha256 {file.sha256[:12]}...) "
        "beside the file that needs it"
    )


@dataclasses.dataclass(frozen=True)
class _Stamp:
    """A file as it was when looked at: what changes it changes this."""

    path: Path
    nanoseconds: int
    size: int

    @classmethod
    def of(cls, path: Path) -> _Stamp:
        stat = path.stat()
        return cls(path, stat.st_mtime_ns, stat.st_size)


@functools.lru_cache(maxsize=16)
def _sha256(stamp: _Stamp) -> str:
    return FileFingerprint.of(stamp.path).sha256


@functools.lru_cache(maxsize=2)
def _loaded(smpl: _Stamp, uv: tuple[_Stamp, ...]) -> BodySetup:
    return body_setup_from_files(smpl.path, tuple(part.path for part in uv))
