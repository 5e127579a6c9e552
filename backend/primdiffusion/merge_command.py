"""The command `primdiffusion merge`: people as one volume, for renderers that draw one fast and a thousand slowly."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import tyro


@dataclasses.dataclass(frozen=True)
class Merge:
    """Write people as one grid of voxels; the ending of --out says how: .vdb or .npz."""

    humans: tyro.conf.Positional[tuple[Path, ...]]
    """.human files (or .human.safetensors)."""
    out: Path
    """.vdb: grids density and Cd (needs Python's module openvdb); .npz: density, colour, origin, voxel. z up."""
    voxel: float = 0.006
    """Metres a side; finer shows more detail, at eight times the memory for half."""
    pose: Path | None = None
    """.json or .npz with 72 axis-angle numbers (24 joints x 3, radians), for everybody; without it the T pose."""
    frame: int = 0
    """Which frame of a pose file that holds several."""
    apart: float = 1.0
    """Metres between neighbours, side by side, where there are several people."""

    def run(self) -> None:
        """Merges, and prints the file's path."""
        import torch

        from primdiffusion.export.merged_file import check_openvdb, upright_grid, write_grid_npz, write_grid_vdb
        from primdiffusion.human import place
        from primdiffusion.human_file import load_human
        from primdiffusion.pose_file import read_pose
        from primdiffusion.primitives.primitives import Primitives
        from primdiffusion.staging import written_whole

        self._check()
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

    def _check(self) -> None:
        if not self.humans:
            raise ValueError("nobody was named: give at least one .human file")
        if self.out.suffix.lower() not in (".vdb", ".npz"):
            raise ValueError(f"{self.out.name!r} has none of the endings .vdb, .npz: choose one")
        if not self.out.parent.is_dir():
            raise FileNotFoundError(f"there is no folder {self.out.parent}: make it first, or choose another")
        if not (math.isfinite(self.voxel) and self.voxel > 0):
            raise ValueError(f"voxel is {self.voxel}: give their side in metres, above zero")
        if not math.isfinite(self.apart):
            raise ValueError(f"apart is {self.apart}: give metres between neighbours")
        if self.frame and self.pose is None:
            raise ValueError(f"frame {self.frame} was asked for without a pose file: name one with --pose")
