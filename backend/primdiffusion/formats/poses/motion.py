"""Motion: rotations of the 24 joints in each frame, for any body; how much of it a file may hold; built-in poses."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...files.json_files import read_json
from ...files.regular_files import FileError
from ..joints import JOINT_NAMES
from .rotation import to_axis_angle
from .skeleton import joint_positions

UNBACKED_NUMBERS = 4_000_000
"""Numbers of poses that a file may hold however small it is: 15 minutes of SMPL at 60 frames/s, standing still. A
rotation takes 20 times as much memory as the numbers that it is made from."""
NUMBERS_A_BYTE = 4
"""Numbers for each byte of the file beyond that. Recorded motion has at most one, since noise does not compress."""


@dataclasses.dataclass(frozen=True)
class Detected:
    """Properties detected in a file, for the user to check and correct."""

    rig: str = ""
    """SMPL, SMPL-H, SMPL-X, or the naming of the bones; empty where unknown."""
    up: str = ""
    """The file's axis that points up, such as "z" or "-y"."""
    unit: str = "metres"
    """Unit of lengths in the file."""
    fps: float = 0.0
    """Frame rate in the file; 0 where it states none."""
    bones: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """SMPL's joint -> the file's bone, for files with bones."""
    people: tuple[str, ...] = ()
    """Names of the people in a tracker's output."""
    average_legs: bool = False
    """Whether lengths were scaled to average legs, so that they must be scaled to each body."""
    doubt: str = ""
    """A sentence about what makes the up axis doubtful."""


LARGEST_NUMBER = 1e6
"""Largest angle or length in a file, in any unit: larger angles have few digits left after the point."""
MOST_NUMBERS = 40_000_000
"""Largest number of values in an array: an hour of SMPL-X at 60 frames/s has 36 million."""
LARGEST_FPS, SMALLEST_FPS = 10_000.0, 0.1
DEFAULT_FPS = 30.0
"""Frame rate of motion whose file does not state it."""
RATES = ("mocap_framerate", "mocap_frame_rate", "fps", "framerate")
"""Names of a frame rate in files."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """Poses of SMPL's skeleton; y up, facing +z where the pelvis' rotation is the identity."""

    rotations: NDArray[np.float64]
    """Each joint about the world's rest axes, relative to its parent [F, 24, 3, 3]; the first is the whole body's."""
    translations: NDArray[np.float64]
    """Translations of the whole body [F, 3], metres, after the rotations."""
    fps: float
    """Frames per second; 1 for single poses."""
    name: str
    """Name of the source."""
    detected: Detected = dataclasses.field(default_factory=Detected)

    def __post_init__(self) -> None:
        frames = len(self.rotations)
        if self.rotations.shape != (frames, 24, 3, 3) or self.translations.shape != (frames, 3):
            raise ValueError(
                f"a motion of {frames} frames has rotations [{frames}, 24, 3, 3] and translations [{frames}, 3]; given "
                f"are {self.rotations.shape} and {self.translations.shape}"
            )

    def __len__(self) -> int:
        return len(self.rotations)

    def axis_angle(self) -> NDArray[np.float64]:
        """The rotations as in SMPL's files [F, 24, 3], radians."""
        return to_axis_angle(self.rotations)

    def frames(self, indices: Sequence[int] | NDArray) -> Motion:
        """Some of the frames, in the order given."""
        chosen = np.asarray(indices, np.int64)
        return dataclasses.replace(self, rotations=self.rotations[chosen], translations=self.translations[chosen])

    def joints(self) -> NDArray[np.float64]:
        """Joint positions of the average skeleton [F, 24, 3], metres."""
        return joint_positions(self.rotations, self.translations)


def first_of(arrays: Mapping[str, NDArray], keys: Iterable[str]) -> NDArray | None:
    """The first of the arrays that is there."""
    return next((arrays[key] for key in keys if key in arrays), None)


def check_numbers(arrays: Mapping[str, NDArray], name: str) -> None:
    """Raise FileError, which calls the file `name`, for arrays that are not the numbers of a motion."""
    for key, array in arrays.items():
        if array.dtype.kind not in "iuf":
            raise FileError(name, f"holds {array.dtype} in {key!r} instead of numbers", "save it as numbers")
        if array.size == 0:
            raise FileError(name, f"holds no frame in {key!r}", "export the motion again")
        if not np.isfinite(array).all():
            raise FileError(name, f"holds NaN or infinite numbers in {key!r}", "export the motion again")
        if array.size > MOST_NUMBERS or np.abs(array.astype(np.float64)).max() > LARGEST_NUMBER:
            reason = f"holds more than {MOST_NUMBERS} numbers in {key!r}, or one above {LARGEST_NUMBER:g}"
            raise FileError(name, reason, "cut the motion into pieces, or export it again")


def stated_rate(arrays: Mapping[str, NDArray], name: str) -> float:
    """The frame rate in arrays of a file called `name`; 0 where they state none. Raises FileError."""
    rate = first_of(arrays, RATES)
    stated = float(rate.ravel()[0]) if rate is not None and rate.size == 1 and float(rate.ravel()[0]) > 0 else 0.0
    if stated and not SMALLEST_FPS <= stated <= LARGEST_FPS:
        raise FileError(name, f"states {stated:g} frames per second", "export the motion again")
    return stated


def check_motion_size(path: str | Path, numbers: int) -> None:
    """Raise FileError for more `numbers` of poses than a file of this size may hold, and OSError."""
    most = max(UNBACKED_NUMBERS, NUMBERS_A_BYTE * os.stat(path).st_size)
    if numbers > most:
        reason = f"holds {numbers} numbers of poses, more than the {most} that a file of its size may have"
        raise FileError(path, reason, "cut the motion into pieces")


BUILT_IN_FILE = Path(__file__).with_name("built_in.json")
"""72 axis-angle values by name; written by scripts/bake_poses."""


def built_in_vectors() -> dict[str, NDArray[np.float64]]:
    """Axis-angle vectors [24, 3] by name, radians, y up, relative to the parents; the first is near T."""
    return {name: np.reshape(values, (len(JOINT_NAMES), 3)) for name, values in read_json(BUILT_IN_FILE).items()}
