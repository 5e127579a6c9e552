"""Captures as one array a subject that training maps into memory: nothing to decode, nothing read that is not used.

root/packed/{id}.npy     uint8 [F, C, H, W, 4]: sRGB over black, and the mask
root/packed/{id}.json    what it was made from; a pack of other pictures than those that are there now is not used
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from primdiffusion.capture.reader import CaptureFileError, Captures, Subject
from primdiffusion.formats import capture_layout

FOLDER, FORMAT, VERSION = "packed", "primdiffusion-packed-captures", 1


@dataclasses.dataclass(frozen=True)
class Packing:
    """How far a subject is."""

    subject: str
    kept: bool
    """Whether a pack of the same pictures was there."""
    gigabytes: float


def pack(captures: Captures) -> Iterator[Packing]:
    """Pack every subject that is not; yields each when its array is whole.

    Raises:
        FileNotFoundError, CaptureFileError: a picture is missing or damaged, or cameras differ in size.
        OSError: there is no room.
    """
    for name in captures.subjects:
        subject = captures.subject(name)
        kept = open_pack(subject) is not None
        if not kept:
            pack_subject(subject)
        yield Packing(name, kept, pack_path(subject).stat().st_size / 1e9)


def pack_subject(subject: Subject) -> None:
    """Write one subject's array. Raises what `pack` does."""
    sizes = {(view.height, view.width) for view in subject.views}
    if len(sizes) != 1:
        raise CaptureFileError(f"{subject.folder} has pictures of several sizes: these cannot be packed")
    stamp = source_stamp(subject)
    shape = (subject.frames, len(subject.views), *sizes.pop(), 4)
    with capture_layout.replacing(pack_path(subject)) as path:
        array = np.lib.format.open_memmap(path, mode="w+", dtype=np.uint8, shape=shape)
        for frame in range(shape[0]):
            for camera in range(shape[1]):
                array[frame, camera, ..., :3] = subject.picture("img", frame, camera)
                array[frame, camera, ..., 3] = subject.picture("mask", frame, camera)
        array.flush()
        del array
    with capture_layout.replacing(pack_path(subject).with_suffix(".json")) as path:
        path.write_text(json.dumps({"format": FORMAT, "version": VERSION, "source": stamp}), encoding="utf-8")


def open_pack(subject: Subject) -> UInt8[np.ndarray, "F C H W 4"] | None:
    """A subject's array, mapped; None where there is none, or one of other pictures."""
    path = pack_path(subject)
    try:
        about = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
        if about != {"format": FORMAT, "version": VERSION, "source": source_stamp(subject)}:
            return None
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
    view = subject.views[0]
    wanted = (subject.frames, len(subject.views), view.height, view.width, 4)
    return array if array.dtype == np.uint8 and array.shape == wanted else None


def pack_path(subject: Subject) -> Path:
    """Where a subject's array lies."""
    return subject.folder.parent / FOLDER / f"{subject.name}.npy"


def source_stamp(subject: Subject) -> str:
    """A digest that changes when pictures do: of the completion mark, or of all names, sizes and times without one."""
    digest = hashlib.sha256()
    mark = subject.folder / capture_layout.COMPLETE_FILE
    if mark.is_file():
        digest.update(mark.read_bytes())
    else:
        for path in sorted(p for kind in ("img", "mask") for p in (subject.folder / kind).rglob("*.*")):
            about = path.stat()
            digest.update(f"{path.relative_to(subject.folder)} {about.st_size} {about.st_mtime_ns}\n".encode())
    return digest.hexdigest()
