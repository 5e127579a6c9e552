"""Volumes are written when something shows them: for 3D views by a job in slices, for renders before they begin; and
merged into one, which Cycles renders much faster."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy.app.handlers import persistent

from ..engine.engine import ENGINE
from ..engine.picture import pose_of
from ..files.regular_files import printable, remove_file
from ..formats.answers import MergeAnswer
from ..scene.armature import check_joints
from ..scene.human import HumanTarget, all_humans, session_file
from ..scene.merged import MergedState, merged_folder, pose_digest, publish, read_grid, show_merged, write_grid
from ..scene.representation import set_representation, show_in_viewport
from ..scene.volume_nodes import open_humans, set_folder, volumes_of, write_volumes, writing
from .queue import Job

SLICE_S = 0.08
"""Longest writing between two of Blender's own events, seconds."""


@dataclasses.dataclass
class VolumesJob(Job):
    """Write a human's volumes, then show them in 3D views."""

    kind = method = "volumes"
    undo = "Volumes in Viewport"

    target: HumanTarget
    _steps: Generator[None, None, None] | None = None
    _error: Exception | None = None

    @property
    def label(self) -> str:
        return f"Volumes of {self.target.name}"

    def params(self, folder: Path) -> dict[str, Any]:
        return {}

    def result_here(self, folder: Path) -> Any:
        self._steps = writing(self.target.found())
        return self.label

    def advance(self, folder: Path) -> bool:
        end = time.monotonic() + SLICE_S
        try:
            while self._error is None and time.monotonic() < end:
                next(self._steps)
        except StopIteration:
            return False
        except (OSError, ValueError) as error:  # `finish` reports it
            self._error = error
        return self._error is None

    def finish(self, _context: bpy.types.Context, _result: str, folder: Path) -> str:
        while self.advance(folder):
            pass
        if self._error is not None:
            raise self._error
        person = self.target.found()
        show_in_viewport(person, True)
        set_folder(person, session_file(person).parent, again=True)
        return f"3D views show the volumes of {person.name}"


class Faults:
    """What is wrong with humans of the open file, or with their volumes; empty when nothing is."""

    text = ""

    def report(self, text: str) -> None:
        """Say it once in the console, and in the panel."""
        if self.text != text:
            print(printable(f"PrimDiffusion: {text}"))
        self.text = text


faults = Faults()


def write_or_report(person: bpy.types.Object) -> None:
    """Write a human's volumes; says why where that fails."""
    try:
        write_volumes(person)
    except (OSError, ValueError) as error:
        faults.report(str(error))


@persistent
def open_after_loading(*_: object) -> None:
    """Handler of load_post."""
    faults.text = ""
    open_after_importing()


@persistent
def open_after_importing(*_: object) -> None:
    """Handler of blend_import_post: humans were appended or linked."""
    for fault in open_humans():
        faults.report(fault)


@persistent
def write_before_rendering(scene: bpy.types.Scene, *_: object) -> None:
    """Handler of render_init: every engine but PrimDiffusion draws the volumes. With a window it runs in the render's
    thread, where no data may be made."""
    if scene.render.engine == ENGINE:
        return
    faults.text = ""
    for person in all_humans():  # scenes may hold instances of them alone
        volumes = volumes_of(person)
        if volumes is not None and not volumes.hide_render:
            write_or_report(person)


HANDLERS = (
    ("load_post", open_after_loading),
    ("blend_import_post", open_after_importing),
    ("render_init", write_before_rendering),
)


def unregister() -> None:
    """Forget what was wrong: another file may be open when the extension is enabled again."""
    faults.text = ""


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

    method = "merge"
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

    def finish(self, _context: bpy.types.Context, result: MergeAnswer, folder: Path) -> str:
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
