"""Parameters of draw, checked before any work starts. Imports no torch."""

from __future__ import annotations

import dataclasses
from typing import Any

from primdiffusion.drawing.steps import check_step

VIEWS = ("colour", "depth", "alpha", "boxes")
JOINTS = 24
LARGEST_NUMBER = 1e30
"""Products of larger ones do not fit into float32."""
Matrix = tuple[tuple[float, ...], ...]


@dataclasses.dataclass(frozen=True)
class PersonParams:
    """One of the people in a picture."""

    human: str
    """A person.human.safetensors file."""
    object: list
    """[3][4] world matrix of the armature object; y up, metres."""
    joints: list
    """[24][3][4] from rest to posed in the object's space, SMPL's joint order."""
    betas: list | None = None
    """Shape coefficients; None for the file's."""

    def __post_init__(self) -> None:
        check_numbers("object", self.object, (3, 4))
        check_numbers("joints", self.joints, (JOINTS, 3, 4))
        if self.betas is not None:
            check_numbers("betas", self.betas, (len(self.betas),))


@dataclasses.dataclass(frozen=True)
class DrawParams:
    """Parameters of draw."""

    frame: str
    """A file of (4 + 1) w h float32 that is mapped and filled: premultiplied linear RGBA, then depth; bottom row first.
    w and h are the region's."""
    width: int
    """Of the whole picture, as height."""
    height: int
    intrinsics: list
    """[3][3] of the whole picture, pixels from its top left corner, pixel centres at +0.5."""
    world_to_camera: list
    """[3][4], OpenCV; y up, metres."""
    people: list[PersonParams]
    region: list | None = None
    """[x, y, w, h], pixels from the left and from the bottom; None for the whole picture."""
    clip: list = dataclasses.field(default_factory=lambda: [0.0, 1e10])
    """[start, end], metres along the optical axis."""
    solids: str | None = None
    """An npz of corners [F, 3, 3], colour [F, 3] and holdout [F]."""
    background: list | None = None
    """[r, g, b], linear; None leaves the picture transparent."""
    view: str = "colour"
    step: float = 0.004
    """Metres between samples of a ray through people of natural size; others are sampled in proportion to theirs."""

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 1:
            raise ValueError(f"a picture of {self.width} x {self.height} pixels: choose sides of 1 or more")
        check_numbers("intrinsics", self.intrinsics, (3, 3))
        if not (self.intrinsics[0][0] > 0 and self.intrinsics[1][1] > 0):
            raise ValueError(f"the focal lengths of intrinsics {self.intrinsics} are not positive")
        if self.intrinsics[1][0] != 0 or self.intrinsics[2] != [0, 0, 1]:
            raise ValueError(f"intrinsics are {self.intrinsics}: give [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]")
        check_numbers("world_to_camera", self.world_to_camera, (3, 4))
        check_numbers("clip", self.clip, (2,))
        if not 0 <= self.clip[0] < self.clip[1]:
            raise ValueError(f"clip is {self.clip}: give [start, end] in metres with 0 <= start < end")
        if self.background is not None:
            check_numbers("background", self.background, (3,))
        if self.view not in VIEWS:
            raise ValueError(f"there is no view {self.view!r}: choose from {', '.join(VIEWS)}")
        check_step(self.step)
        if self.region is not None:
            self._check_region(self.region)

    def _check_region(self, region: list) -> None:
        whole = len(region) == 4 and all(isinstance(value, int) and not isinstance(value, bool) for value in region)
        x, y, w, h = region if whole else (0, 0, 0, 0)
        if not (x >= 0 and y >= 0 and w >= 1 and h >= 1 and x + w <= self.width and y + h <= self.height):
            raise ValueError(
                f"region is {region}: give [x, y, w, h] in whole pixels with w and h of 1 or more, inside the picture "
                f"of {self.width} x {self.height}"
            )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of what is drawn."""
        return (self.width, self.height) if self.region is None else (self.region[2], self.region[3])

    @property
    def corner(self) -> tuple[int, int]:
        """The pixel of the whole picture, from its left and top, that is the region's top left one."""
        return (0, 0) if self.region is None else (self.region[0], self.height - self.region[1] - self.region[3])


def check_numbers(name: str, value: Any, shape: tuple[int, ...]) -> None:
    """ValueError that names `name` unless `value` is nested lists of this shape, of numbers that float32 can hold."""
    wanted = " x ".join(map(str, shape))
    if not shape:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{name} holds {value!r:.40} where a number should be")
        if not -LARGEST_NUMBER <= value <= LARGEST_NUMBER:
            raise ValueError(f"{name} holds {value!r:.40}: give finite numbers, of at most {LARGEST_NUMBER:g}")
        return
    if not isinstance(value, list) or len(value) != shape[0]:
        given = f"{len(value)} entries" if isinstance(value, list) else f"{value!r:.40}"
        raise ValueError(f"{name} holds {given} where {wanted} numbers should be")
    for entry in value:
        check_numbers(name, entry, shape[1:])
