"""A person as one volume: the child's grid as a VDB file, or a sequence of them, and the object that shows it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
import zlib
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from .files import VolumeWriteError, folders_of, person_file_name, stored_path
from .human import armature_of
from .material import person_material

MARK = "primdiffusion_merged"
"""Custom property of a merged object: its `MergedState` as JSON."""
_DECIMALS = 4
"""Of matrices, in digests: a tenth of a millimetre."""


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
    """`pose_digest` of each frame; a single one: the same in every frame."""
    voxel: float
    start: int = 0
    """The scene's frame of the first pose, where there are several."""

    def shows(self, digest: str, frame: int) -> bool:
        """Whether this is the person in this pose at this frame of the scene."""
        index = min(max(frame - self.start, 0), len(self.poses) - 1) if len(self.poses) > 1 else 0
        return self.poses[index] == digest


def read_grid(path: Path) -> MergedGrid:
    """Reads the child's file. Raises ValueError for a damaged one, OSError."""
    import zipfile  # slow to import, and not needed to register

    try:
        with np.load(path, allow_pickle=False) as stored:
            grid = MergedGrid(stored["density"], stored["colour"], stored["origin"], float(stored["voxel"]))
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"the merged grid {path.name!r} is damaged ({error}); merge again") from error
    if grid.density.ndim != 3 or grid.colour.shape != (*grid.density.shape, 3) or grid.origin.shape != (3,):
        raise ValueError(f"the merged grid {path.name!r} holds {grid.colour.shape} colours; merge again")
    return grid


def index_to_local(grid: MergedGrid, blender_version: tuple[int, ...]) -> NDArray[np.float64]:
    """VDB's row-vector transform [4, 4]; Cycles before 5.0 draws half a voxel too high on each axis (see `volumes`)."""
    transform = np.diag([grid.voxel] * 3 + [1.0])
    transform[3, :3] = grid.origin - (0.5 * grid.voxel if blender_version < (5, 0) else 0.0)
    return transform


def write_grid(grid: MergedGrid, path: Path) -> str:
    """Writes `density` and `Cd` as half floats; returns a digest of what they hold.

    `bpy.utils.expose_bundled_modules()` must have been called before. Raises VolumeWriteError.
    """
    import openvdb  # Blender's own

    transform = openvdb.createLinearTransform(index_to_local(grid, bpy.app.version).tolist())
    density, colour = openvdb.FloatGrid(), openvdb.Vec3SGrid()
    density.name, density.gridClass = "density", openvdb.GridClass.FOG_VOLUME
    colour.name = "Cd"
    for written, values in ((density, grid.density), (colour, grid.colour)):
        written.copyFromArray(np.ascontiguousarray(values, np.float32))
        written.transform = transform
        written.saveFloatAsHalf = True
    try:
        openvdb.write(str(path), grids=[density, colour])
    except (OSError, RuntimeError) as error:  # openvdb reports a full disk as RuntimeError
        raise _write_error(path.parent, error) from error
    digest = hashlib.sha256(index_to_local(grid, bpy.app.version).tobytes())
    for values in (grid.density, grid.colour):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def publish(files: Sequence[Path], digests: Sequence[str], folder: Path) -> list[Path]:
    """Copies written grids into `folder` under names of their content; several as a sequence. All files or none.

    Raises VolumeWriteError.
    """
    whole = hashlib.sha256("".join(digests).encode()).hexdigest()[:12]
    ends = [f"_{number:04d}" for number in range(1, len(files) + 1)] if len(files) > 1 else [""]
    targets = [folder / f"merged_{whole}{end}.vdb" for end in ends]
    made: list[Path] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for source, target in zip(files, targets, strict=True):
            if target.is_file():
                continue
            made.append(target)
            unfinished = target.with_name(f".{target.name}.part")
            made.append(unfinished)
            shutil.copyfile(source, unfinished)
            os.replace(unfinished, target)
    except OSError as error:
        for path in made:
            path.unlink(missing_ok=True)
        raise _write_error(folder, error) from error
    return targets


def show_merged(collection: bpy.types.Collection, files: Sequence[Path], state: MergedState) -> bpy.types.Object:
    """The object that shows these files, made or pointed to them; it moves with the armature object. Hides nothing."""
    merged = merged_of(collection)
    if merged is None:
        label = f"{collection.name}_merged"
        merged = bpy.data.objects.new(label, bpy.data.volumes.new(label))
        merged.parent = armature_of(collection)
        merged.data.render.space = "WORLD"
        merged.data.materials.append(person_material(collection))
        collection.objects.link(merged)
    volume = merged.data
    volume.filepath = stored_path(files[0])
    volume.is_sequence = len(files) > 1
    if volume.is_sequence:
        volume.frame_start, volume.frame_duration, volume.frame_offset = state.start, len(files), 0
        volume.sequence_mode = "EXTEND"
    merged[MARK] = json.dumps(dataclasses.asdict(state))
    return merged


def merged_of(collection: bpy.types.Collection) -> bpy.types.Object | None:
    """The person's merged object; None where there is none."""
    return next((thing for thing in collection.all_objects if thing.type == "VOLUME" and MARK in thing), None)


def merged_state(merged: bpy.types.Object) -> MergedState:
    """What it shows."""
    kept = json.loads(merged[MARK])
    return MergedState(**{**kept, "poses": tuple(kept["poses"])})


def remove_merged(collection: bpy.types.Collection) -> None:
    """Take the merged object out of the .blend; its files stay, for undo."""
    merged = merged_of(collection)
    if merged is not None:
        bpy.data.volumes.remove(merged.data)  # takes the object along


def merged_folder(collection: bpy.types.Collection) -> Path:
    """Where merged files go: beside the person's volumes."""
    return folders_of(collection)[0]


def pose_digest(collection: bpy.types.Collection, joints: NDArray, betas: Sequence[float] | None) -> str:
    """What tells a person in a pose from others: their file, shape and joints [24, 3, 4]."""
    rounded = np.round(np.asarray(joints, np.float64), _DECIMALS) + 0.0  # no negative zeros
    shape = [] if betas is None else [round(float(value), _DECIMALS) for value in betas]
    digest = hashlib.sha256(f"{person_file_name(collection)} {shape}".encode())
    digest.update(rounded.tobytes())
    return digest.hexdigest()[:16]


def _write_error(folder: Path, error: BaseException) -> VolumeWriteError:
    return VolumeWriteError(
        f"the merged volume could not be written to {str(folder)!r} ({error}); save the .blend in a folder with write "
        "permission and free space"
    )
