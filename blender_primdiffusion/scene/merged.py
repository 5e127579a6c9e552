"""A human as one volume: the grid from the child as a VDB file or sequence, and the object that shows it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..files.arrays import all_finite, check_shapes, read_arrays
from ..files.regular_files import FileError, as_file_error, check_inside, real_path, remove_file
from ..files.whole_files import atomic_path
from .blend_values import stored_record
from .human import link_part, parts_of, session_folder, state_of, write_error
from .volume_nodes import volume_material
from .volumes import write_vdb

MARK = "primdiffusion_merged"
"""Custom property of a merged object: its `MergedState` as JSON."""
_SHAPES = {"density": ("X", "Y", "Z"), "colour": ("X", "Y", "Z", 3), "origin": (3,), "voxel": ()}
_DECIMALS = 4
"""Decimals of matrices in digests: a tenth of a millimetre."""


@dataclasses.dataclass(frozen=True)
class MergedGrid:
    """What the child merges; z up, in the armature's space."""

    density: NDArray[np.float16]
    """Opacity per metre [X, Y, Z]."""
    colour: NDArray[np.float16]
    """Linear RGB [X, Y, Z, 3]."""
    origin: NDArray[np.float64]
    """Centre of the first voxel [3], metres."""
    voxel: float
    """Metres."""


@dataclasses.dataclass(frozen=True)
class MergedState:
    """What a merged volume shows."""

    poses: tuple[str, ...]
    """`pose_digest` of each frame; a single one holds for every frame."""
    voxel: float
    start: int = 0
    """The scene's frame of the first pose, where there are several."""

    def shows(self, digest: str, frame: int) -> bool:
        """Whether this is the human in this pose at this frame of the scene."""
        index = min(max(frame - self.start, 0), len(self.poses) - 1) if len(self.poses) > 1 else 0
        return self.poses[index] == digest


def read_grid(path: Path) -> MergedGrid:
    """Read the child's file. Raises ValueError for a damaged one, OSError."""
    with as_file_error(path, "is not a merged volume or is damaged", "merge again"):
        stored = read_arrays(path, tuple(_SHAPES))
        check_shapes(path, stored, _SHAPES, {})
        faulty = [name for name, values in stored.items() if not all_finite(values)]
        if faulty or not stored["voxel"] > 0:
            raise ValueError(f"{(faulty or ['voxel'])[0]!r} holds NaN or impossible numbers")
    return MergedGrid(stored["density"], stored["colour"], stored["origin"], float(stored["voxel"]))


def write_grid(grid: MergedGrid, path: Path) -> str:
    """Write a grid as a VDB file; returns a digest of its content. Raises FileError."""
    transform = np.diag([grid.voxel] * 3 + [1.0])  # VDB's are of row vectors
    transform[3, :3] = grid.origin
    try:
        write_vdb(path, grid.density, grid.colour, transform)
    except (OSError, RuntimeError) as error:  # openvdb reports a full disk as RuntimeError
        raise write_error(path.parent, error) from error
    digest = hashlib.sha256(transform.tobytes())
    for values in (grid.density, grid.colour):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def publish(files: Sequence[Path], digests: Sequence[str], folder: Path) -> list[Path]:
    """Copy written grids into `folder` under names made from their content; several become a sequence.

    Raises FileError, and then copies none.
    """
    digest = hashlib.sha256("".join(digests).encode()).hexdigest()[:12]
    ends = [f"_{number:04d}" for number in range(1, len(files) + 1)] if len(files) > 1 else [""]
    targets = [folder / f"merged_{digest}{end}.vdb" for end in ends]
    new = [target for target in targets if not target.is_file()]
    try:
        for source, target in zip(files, targets, strict=True):
            if target in new:
                _copy(source, target)
    except (OSError, FileError) as error:
        for path in new:
            if path.is_file():
                remove_file(path, folder)
        if isinstance(error, FileError):  # a link, which it names
            raise
        raise write_error(folder, error) from error
    return targets


def show_merged(person: bpy.types.Object, files: Sequence[Path], state: MergedState) -> bpy.types.Object:
    """Show these files in the human's merged object, made if there is none; it moves with the armature object."""
    merged = merged_of(person)
    if merged is None:
        label = f"{person.name}_merged"
        merged = bpy.data.objects.new(label, bpy.data.volumes.new(label))
        merged.parent = person
        merged.data.render.space = "WORLD"
        merged.data.materials.append(volume_material())
        link_part(person, merged)
    volume = merged.data
    volume.filepath = _stored(files[0])
    volume.is_sequence = len(files) > 1
    if volume.is_sequence:
        volume.frame_start, volume.frame_duration, volume.frame_offset = state.start, len(files), 0
        volume.sequence_mode = "EXTEND"
    merged[MARK] = json.dumps(dataclasses.asdict(state))
    return merged


def merged_of(person: bpy.types.Object) -> bpy.types.Object | None:
    """The human's merged object, if any."""
    return next((obj for obj in parts_of(person) if obj.type == "VOLUME" and MARK in obj), None)


def merged_state(merged: bpy.types.Object) -> MergedState:
    """What a merged object shows. Raises ValueError where the .blend does not hold that."""
    saved = stored_record(merged, MARK)
    poses, voxel, start = (saved.get(name) for name in ("poses", "voxel", "start"))
    if not (isinstance(poses, list) and poses and isinstance(voxel, int | float) and isinstance(start, int)):
        raise ValueError(f"the custom property {MARK!r} of {merged.name!r} was changed by hand: merge again")
    return MergedState(tuple(map(str, poses)), float(voxel), start)


def remove_merged(person: bpy.types.Object) -> None:
    """Remove the merged object from the .blend; its files stay for undo."""
    merged = merged_of(person)
    if merged is not None:
        bpy.data.volumes.remove(merged.data)  # removes the object too


def merged_folder() -> Path:
    """Where merged files go: `<blendname>_volumes` beside the .blend, a temporary folder while it is unsaved."""
    blend = Path(bpy.data.filepath)
    return real_path(blend).parent / f"{blend.stem}_volumes" if blend.name else session_folder() / "merged"


def _stored(path: Path) -> str:
    """A path as the .blend stores it: relative (`//`) when it is saved, else absolute."""
    try:
        return bpy.path.relpath(str(path)) if bpy.data.filepath else str(path)
    except ValueError:  # another drive on Windows
        return str(path)


def _copy(source: Path, target: Path) -> None:
    check_inside(target, target.parent.parent)
    target.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(target) as unfinished:
        shutil.copyfile(source, unfinished)


def pose_digest(person: bpy.types.Object, joints: NDArray, betas: Sequence[float] | None) -> str:
    """Identifies a human in a pose: hash of its state, the shape and the joints [24, 3, 4]."""
    rounded = np.round(np.asarray(joints, np.float64), _DECIMALS) + 0.0  # no negative zeros
    shape = [] if betas is None else [round(float(value), _DECIMALS) for value in betas]
    digest = hashlib.sha256(f"{state_of(person)} {shape}".encode())
    digest.update(rounded.tobytes())
    return digest.hexdigest()[:16]
