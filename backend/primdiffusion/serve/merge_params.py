"""Parameters of merge, merge_frames and fit_gain, checked before any work starts. Imports no torch."""

from __future__ import annotations

import dataclasses
import math

from primdiffusion.serve.draw_params import PersonParams


@dataclasses.dataclass(frozen=True)
class MergeParams:
    """Parameters of merge."""

    people: list[PersonParams]
    """As of draw."""
    out: str
    """The .npz to write."""
    voxel: float = 0.006
    """Metres."""

    def __post_init__(self) -> None:
        check_voxel(self.voxel)
        check_anybody(self.people)
        if not self.out:
            raise ValueError("out is empty: name the file to write")


@dataclasses.dataclass(frozen=True)
class MergeFramesParams:
    """Parameters of merge_frames."""

    people: list[PersonParams]
    """As of draw: one person, once for each frame."""
    out_dir: str
    """Folder for 0000.npz, 0001.npz, ...; made if missing."""
    voxel: float = 0.006
    """Metres."""

    def __post_init__(self) -> None:
        check_voxel(self.voxel)
        check_anybody(self.people)
        if not self.out_dir:
            raise ValueError("out_dir is empty: name a folder")


@dataclasses.dataclass(frozen=True)
class FitGainParams:
    """Parameters of fit_gain."""

    people: list[PersonParams]
    """As of draw, in the pose to fit in."""

    def __post_init__(self) -> None:
        check_anybody(self.people)


def check_anybody(people: list[PersonParams]) -> None:
    """ValueError where there is nobody."""
    if not people:
        raise ValueError("people is empty: name at least one person")


def check_voxel(voxel: float) -> None:
    """ValueError unless this is a length."""
    if not (math.isfinite(voxel) and voxel > 0):
        raise ValueError(f"voxel is {voxel}: give their side in metres, above zero")
