"""Merge humans into voxel grids for other renderers.

`primdiffusion merge`, and `merge` and `merge_frames` of JSON-RPC.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from primdiffusion.commands.frame import PosedPerson
from primdiffusion.commands.request import Pace, ReportProgress, check_ending, check_voxel, parse
from primdiffusion.formats.requests import VOXEL
from primdiffusion.formats.whole_files import written_whole

if TYPE_CHECKING:
    from primdiffusion.commands.session import Session
    from primdiffusion.human import Human
    from primdiffusion.primitives.primitives import Primitives


@dataclasses.dataclass(frozen=True, kw_only=True)
class MergeRequest:
    """Merge humans into one grid, z up. Needs no checkpoint."""

    people: list[PosedPerson]
    out: Path
    """Output .npz."""
    voxel: float = VOXEL
    """Voxel size, metres."""

    def check(self) -> None:
        """See `RequestRecord`."""
        check_ending(self.out, ".npz")
        check_voxel(self.voxel)
        _check_people(self.people)

    def run(self, session: Session, report: ReportProgress) -> dict[str, Any]:
        """Return the path and shape of the grid. Raises as load_human, place_skinned and merge."""
        began = time.perf_counter()
        report("merge", 0, 1, None)
        primitives = _together(self.people)
        with written_whole(self.out) as path:
            shape = _write(path, primitives, self.voxel)
            report("merge", 1, 1, 0.0)  # the last chance to cancel
        return {"out": str(self.out), "shape": shape, "seconds": round(time.perf_counter() - began, 3)}


@dataclasses.dataclass(frozen=True, kw_only=True)
class MergeFramesRequest:
    """Write a grid for each frame of a human. Needs no checkpoint."""

    people: list[PosedPerson]
    """The same human, once for each frame."""
    out_dir: Path
    """Output folder of 0000.npz, 0001.npz, ...; created if missing."""
    voxel: float = VOXEL
    """Voxel size, metres."""

    def check(self) -> None:
        """See `RequestRecord`."""
        check_voxel(self.voxel)
        _check_people(self.people)

    def run(self, session: Session, report: ReportProgress) -> dict[str, Any]:
        """Write the grids one by one, each atomically, so that another program can load them meanwhile.

        Returns their paths. Raises as `MergeRequest`; grids written before an error stay.
        """
        from primdiffusion.human_file import load_human  # torch is loaded late

        began, pace, count = time.perf_counter(), Pace(), len(self.people)
        self.out_dir.mkdir(parents=True, exist_ok=True)
        load = functools.lru_cache(maxsize=1)(load_human)
        report("merge", 0, count, None)
        files = []
        for index, person in enumerate(self.people):
            file = self.out_dir / f"{index:04d}.npz"
            with written_whole(file) as path:
                _write(path, _placed(load(person.human), person), self.voxel)
            files.append(str(file))
            report("merge", index + 1, count, pace.left(index + 1, count))
        return {"files": files, "seconds": round(time.perf_counter() - began, 3)}


def _check_people(people: list[PosedPerson]) -> None:
    if not people:
        raise ValueError("people is empty: give at least one")
    for person in people:
        person.check()


def _together(people: list[PosedPerson]) -> Primitives:
    # torch is loaded late
    from primdiffusion.human_file import load_human
    from primdiffusion.primitives.primitives import Primitives

    return Primitives.together([_placed(load_human(person.human), person) for person in people])


def _placed(human: Human, person: PosedPerson) -> Primitives:
    import torch  # late

    # torch is loaded late
    from primdiffusion.human import place_skinned
    from primdiffusion.reshaping import reshaped

    if person.betas is not None:
        human = reshaped(human, torch.tensor(person.betas, dtype=torch.float32))
    joints, matrix = (torch.tensor(numbers, dtype=torch.float32) for numbers in (person.joints, person.object))
    return place_skinned(human, joints, matrix)


def _write(path: Path, primitives: Primitives, voxel: float) -> list[int]:
    from primdiffusion.export.merged_file import upright_grid, write_grid_npz  # torch is loaded late

    grid = upright_grid(primitives, voxel)
    write_grid_npz(path, grid)
    return list(grid.density.shape)


@dataclasses.dataclass(frozen=True)
class MergeCommand:
    """Merge humans into one voxel grid; the extension of --out selects the format: .vdb or .npz."""

    humans: tyro.conf.Positional[tuple[Path, ...]]
    """.human files (or .human.safetensors)."""
    out: Path
    """.vdb: grids density and Cd (needs Python's module openvdb); .npz: density, colour, origin, voxel. z up."""
    voxel: float = VOXEL
    """Voxel size, metres; half the size shows more detail at eight times the memory."""
    pose: Path | None = None
    """.json or .npz with 72 axis-angle numbers (24 joints x 3, radians), for all humans; the default is the T pose."""
    frame: int = 0
    """Frame of a pose file with several."""
    apart: float = 1.0
    """Distance between neighbours, side by side, metres."""

    def merge(self) -> None:
        """Merge, and print the path."""
        import torch  # late

        # torch is loaded late
        from primdiffusion.export.merged_file import check_openvdb, upright_grid, write_grid_npz, write_grid_vdb
        from primdiffusion.human import place
        from primdiffusion.human_file import load_human
        from primdiffusion.pose_file import read_pose
        from primdiffusion.primitives.primitives import Primitives

        if self.out.suffix.lower() == ".vdb":
            check_openvdb()
        pose = None if self.pose is None else read_pose(self.pose, self.frame)
        people = []
        for number, path in enumerate(self.humans):
            placed = place(load_human(path), pose)
            aside = torch.tensor([(number - (len(self.humans) - 1) / 2) * self.apart, 0.0, 0.0])
            people.append(dataclasses.replace(placed, position=placed.position + aside))
        grid = upright_grid(Primitives.together(people), self.voxel)
        with written_whole(self.out) as path:
            (write_grid_vdb if self.out.suffix.lower() == ".vdb" else write_grid_npz)(path, grid)
        print(self.out)

    def check(self) -> None:
        """See `RequestRecord`."""
        if not self.humans:
            raise ValueError("no file was given: give at least one .human file")
        check_ending(self.out, ".vdb", ".npz")
        if not self.out.parent.is_dir():
            raise FileNotFoundError(f"there is no folder {self.out.parent}: create it, or choose another")
        check_voxel(self.voxel)
        if not math.isfinite(self.apart):
            raise ValueError(f"apart is {self.apart}: give metres between neighbours")
        if self.frame and self.pose is None:
            raise ValueError(f"frame {self.frame} was requested without a pose file: give one with --pose")


def run(arguments: Sequence[str]) -> None:
    """Run a command line; raises its errors."""
    parse(MergeCommand, arguments, "merge").merge()
