"""Jobs for other renderers: merged volumes."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..engine.picture import pose_of
from ..files.regular_files import remove_file
from ..formats.answers import MergeFramesAnswer
from ..scene.armature import check_joints
from ..scene.human import HumanTarget
from ..scene.merged import MergedState, merged_folder, pose_digest, publish, read_grid, show_merged, write_grid
from ..scene.representation import set_representation
from .queue import Job


@dataclasses.dataclass(frozen=True)
class PoseSnapshot:
    """A human in one pose."""

    params: dict[str, Any]
    """Parameters of the child, with the armature object at the origin: the merged volume moves with that object."""
    digest: str
    """See `pose_digest`."""

    @classmethod
    def capture(cls, person: bpy.types.Object, armature: bpy.types.Object | None = None) -> PoseSnapshot:
        """The current pose of the human, or of the evaluated `armature` if given.

        Raises ValueError for a renamed bone or a pose that holds NaN, FileNotFoundError where the human's file is
        missing.
        """
        check_joints(person)
        armature = person if armature is None else armature
        pose = pose_of(armature, np.eye(4))
        return cls(pose.params(), pose_digest(person, pose.joints, pose.betas))


@dataclasses.dataclass
class MergeJob(Job):
    """Merge a human into one volume, or one for each frame."""

    method = "merge_frames"
    undo = "Merge Human"

    target: HumanTarget
    moments: list[PoseSnapshot]
    """One for a volume, else one for each frame."""
    voxel: float
    """Metres."""
    start: int = 0
    """The first frame's number, of several."""
    _digests: list[str] = dataclasses.field(default_factory=list, init=False, repr=False)
    """Digests of the VDB files written so far."""
    _error: OSError | ValueError | None = dataclasses.field(default=None, init=False, repr=False)

    @property
    def kind(self) -> str:
        return "merge" if len(self.moments) == 1 else "merge_frames"

    @property
    def label(self) -> str:
        frames = f", {len(self.moments)} frames" if len(self.moments) > 1 else ""
        return f"Merge {self.target.name}{frames}"

    def params(self, folder: Path) -> dict[str, Any]:
        """The grids become VDB files as they appear: see `advance`."""
        file = self.target.file_now()
        self._digests, self._error = [], None
        people = [{**moment.params, "human": file} for moment in self.moments]
        return {"people": people, "voxel": self.voxel, "out_dir": str(folder)}

    def advance(self, folder: Path) -> bool:
        """Turn the child's next grid into a VDB file, where there is one."""
        grid = _grid(folder, len(self._digests))
        if self._error is not None or len(self._digests) == len(self.moments) or not grid.is_file():
            return False
        try:
            self._digests.append(write_grid(read_grid(grid), grid.with_suffix(".vdb")))
            remove_file(grid, folder)
        except (OSError, ValueError) as error:  # `finish` reports it
            self._error = error
        return _grid(folder, len(self._digests)).is_file()

    def finish(self, _context: bpy.types.Context, result: MergeFramesAnswer, folder: Path) -> str:
        person = self.target.found()
        while self.advance(folder):
            pass
        if self._error is not None:
            raise self._error
        written = [_grid(folder, index).with_suffix(".vdb") for index in range(len(self.moments))]
        files = publish(written, self._digests, merged_folder())
        show_merged(person, files, MergedState(tuple(m.digest for m in self.moments), self.voxel, self.start))
        set_representation(person, "MERGED")
        size = sum(path.stat().st_size for path in files) / 1e6
        what = f"{len(files)} frames of {person.name}" if len(files) > 1 else person.name
        return f"Merged {what} at {self.voxel * 1e3:.3g} mm in {result.seconds:.1f} s, {size:.1f} MB"


def _grid(folder: Path, index: int) -> Path:
    return folder / f"{index:04d}.npz"
