"""People as .human files, 3D Gaussians and VDB sequences; people from .human files."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..engine.picture import pose_of
from ..motion.skeleton import unchain
from ..scene.armature import pose_from_joint_rotations
from ..scene.export_model import FrameRange, check_ready, scene_with_only
from ..scene.files import person_file
from ..scene.human import armature_of
from ..scene.human_file import HumanMotion, motion_in, read_tensors, reshaped, with_motion, write_tensors
from ..scene.keyframes import keyframe_poses
from ..scene.merged import MergedGrid, read_grid, write_grid
from ..scene.shape import BODY_FILE, betas_of, generated_betas, has_custom_shape, shape_model_of
from .job import Job
from .person import build_person
from .target import Target


def posed_now(context: bpy.types.Context, person: bpy.types.Collection) -> dict[str, Any]:
    """The person at the current frame (see `posed_frames`)."""
    return posed_frames(context, person, [context.scene.frame_current])[0]


def posed_frames(
    context: bpy.types.Context, person: bpy.types.Collection, frames: Iterable[int]
) -> list[dict[str, Any]]:
    """The person at these frames: file, the object's place, joints and shape, as of the child's draw.

    Raises ValueError for an armature in Edit Mode or without SMPL's bones, FileNotFoundError where the file is missing.
    """
    armature = armature_of(person)
    check_ready(armature)
    found = []
    with scene_with_only(context, armature) as scene:
        for frame in frames:
            if frame != scene.frame_current:
                scene.frame_set(frame)
            evaluated = armature.evaluated_get(scene.view_layers[0].depsgraph)
            found.append(pose_of(evaluated, np.array(evaluated.matrix_world, np.float64), person).params())
    return found


def write_human(
    context: bpy.types.Context, person: bpy.types.Collection, path: Path, frames: FrameRange | None
) -> None:
    """Writes the person with the shape they have now, and their motion on `frames`. Raises ValueError or OSError.

    The motion is that of the joints in the armature's space, constraints and layers included; where the object stands
    is left out.
    """
    human = read_tensors(person_file(person))
    if has_custom_shape(person):
        betas, growth = betas_of(person), None
        if BODY_FILE in person:  # people of earlier versions have none, and boxes that keep their size
            growth = shape_model_of(person).growth(generated_betas(person), betas)
        human = reshaped(human, betas, growth)
    motion = None if frames is None else _motion(context, person, frames)
    write_tensors(path, with_motion(human, motion))


def _motion(context: bpy.types.Context, person: bpy.types.Collection, frames: FrameRange) -> HumanMotion:
    from ..scene.convention import points_to_backend
    from ..scene.human import armature_of

    numbers = range(frames.first, frames.last + 1)
    joints = np.array([entry["joints"] for entry in posed_frames(context, person, numbers)], np.float64)
    pelvis = points_to_backend(np.array(armature_of(person).data.bones["pelvis"].head_local))
    left, _, right = np.linalg.svd(joints[..., :3])
    rotations = left @ right  # the nearest rotations: bones may be scaled
    translations = joints[:, 0, :, :3] @ pelvis + joints[:, 0, :, 3] - pelvis
    render = context.scene.render
    return HumanMotion(
        np.array(numbers, np.float32),
        unchain(rotations).astype(np.float32),
        translations.astype(np.float32),
        render.fps / render.fps_base,
    )


_PICTURE_PX = 16
"""The child's pictures of the imported person are of no use here."""


@dataclasses.dataclass(frozen=True)
class ExportGaussiansJob(Job):
    """A person in a pose as splats."""

    kind = "export_gaussians"
    method = "gaussians"

    target: Target
    path: Path
    person: dict[str, Any]
    """Whom, and in which pose: as of draw."""
    limit: int

    @property
    def label(self) -> str:
        """For people."""
        return f"Export {self.target.name} to {self.path.name}"

    def params(self, folder: Path) -> dict[str, Any]:
        """Of the child's method."""
        pose = {name: self.person[name] for name in ("object", "joints", "betas")}
        return {"person": self.target.file_now(), **pose, "limit": self.limit, "out": str(folder / "gaussians.ply")}

    def finish(self, _context: bpy.types.Context, result: dict[str, Any], _folder: Path) -> str:
        """Put the file in its place."""
        put(Path(result["out"]), self.path)
        size = self.path.stat().st_size / 1e6
        return f"Exported {self.target.name} to {self.path.name}: {result['gaussians']} Gaussians, {size:.1f} MB"


@dataclasses.dataclass(frozen=True)
class ExportVdbSequenceJob(Job):
    """A person as one grid for each frame, in the world's place."""

    kind = "export_vdb_sequence"
    method = "merge_frames"

    target: Target
    folder: Path
    stem: str
    people: list[dict[str, Any]]
    """As of draw, an entry for each frame."""
    first: int
    """The first frame's number."""
    voxel: float

    @property
    def label(self) -> str:
        """For people."""
        return f"Export {len(self.people)} VDB files of {self.target.name}"

    def params(self, folder: Path) -> dict[str, Any]:
        """Of the child's method."""
        file = self.target.file_now()
        people = [{**person, "human": file} for person in self.people]
        return {"people": people, "voxel": self.voxel, "out_dir": str(folder)}

    def finish(self, _context: bpy.types.Context, result: dict[str, Any], folder: Path) -> str:
        """Write all files aside, then put them in their places."""
        written = []
        for index, grid in enumerate(result["files"]):
            name = f"{self.stem}_{self.first + index:04d}.vdb"
            write_grid(_as_others_read_it(read_grid(Path(grid))), folder / name)
            Path(grid).unlink()
            written.append(folder / name)
        size = sum(path.stat().st_size for path in written) / 1e6
        for path in written:
            put(path, self.folder / path.name)
        return f"Exported {len(written)} frames of {self.target.name} to {self.folder.name}: {size:.0f} MB"


@dataclasses.dataclass(frozen=True)
class ImportHumanJob(Job):
    """The person of a .human file, with the motion that it may hold."""

    kind = "import_human"
    method = "human_npz"
    undo = "Import Human"

    path: str
    at: tuple[float, float, float] | None = None
    """Where to put the person, metres; None for the world's origin."""

    @property
    def label(self) -> str:
        """For people."""
        return f"Import {Path(self.path).name}"

    @property
    def new_person(self) -> str:
        """As the file is called."""
        return name_of(self.path)

    def params(self, folder: Path) -> dict[str, Any]:
        """Of the child's method."""
        return {"person": self.path, "out_dir": str(folder), "size": _PICTURE_PX}

    def finish(self, context: bpy.types.Context, result: dict[str, Any], _folder: Path) -> str:
        """Build the person, and let them move."""
        motion = motion_in(read_tensors(Path(self.path)))
        person, notice = build_person(context, result, "Imported", name_of(self.path))
        armature = armature_of(person)
        if motion is not None:
            _move(armature, motion)
        if self.at is not None:
            armature.location.xy = self.at[:2]
            armature.location.z += self.at[2]
        return notice


def name_of(path: str) -> str:
    """What a person from this file is called."""
    name = Path(path).name
    for ending in (".safetensors", ".human"):
        name = name.removesuffix(ending)
    return name or "Human"


def put(source: Path, target: Path) -> None:
    """Copies a finished file to its place; a reader never sees half of it. Raises OSError."""
    unfinished = target.with_name(f".{target.name}.part")
    try:
        shutil.copyfile(source, unfinished)
        unfinished.replace(target)
    finally:
        unfinished.unlink(missing_ok=True)


def _as_others_read_it(grid: MergedGrid) -> MergedGrid:
    """`write_grid` moves grids for old versions of Cycles by half a voxel; files for other programs must not be."""
    shift = 0.5 * grid.voxel if bpy.app.version < (5, 0) else 0.0
    return dataclasses.replace(grid, origin=grid.origin + shift)


def _move(armature: bpy.types.Object, motion: HumanMotion) -> None:
    if len(motion.frames) == 1:
        pose_from_joint_rotations(armature, motion.rotations[0], motion.translations[0])
        return
    keyframe_poses(
        armature, np.asarray(motion.frames, np.float64), motion.rotations, motion.translations, armature.name
    )
