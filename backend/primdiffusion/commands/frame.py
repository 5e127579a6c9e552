"""A frame for the render engine or the viewport: posed humans and a camera. Imports no torch."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from primdiffusion.commands.request import check_betas, check_numbers, check_sides
from primdiffusion.formats.joints import JOINT_NAMES
from primdiffusion.formats.requests import RAY_STEP, VIEWS, View, check_step


@dataclasses.dataclass(frozen=True)
class PosedPerson:
    """A human posed by an armature."""

    human: Path
    """A person.human.safetensors file."""
    object: list
    """[3][4] world matrix of the armature object; y up, metres."""
    joints: list
    """[24][3][4] rest to posed in object space, SMPL's joint order."""
    betas: list | None = None
    """Shape coefficients; None for those of the file."""

    def check(self) -> None:
        """Raise ValueError for arrays of wrong shape and numbers that are not finite."""
        check_numbers("object", self.object, (3, 4))
        check_numbers("joints", self.joints, (len(JOINT_NAMES), 3, 4))
        check_betas(self.betas)


@dataclasses.dataclass(frozen=True)
class FrameSpec:
    """A frame to draw: humans, camera, and the file to draw into."""

    frame: Path
    """A file of (4 + 1) w h float32 to map and fill: premultiplied linear RGBA, then depth; bottom row first. w and h
    are those of the region."""
    width: int
    """Width and height of the whole image, pixels."""
    height: int
    intrinsics: list
    """[3][3] of the whole image, in pixels from its top left corner, pixel centres at +0.5."""
    world_to_camera: list
    """[3][4], OpenCV; y up, metres."""
    people: list[PosedPerson]
    region: list | None = None
    """[x, y, w, h], pixels from the left and from the bottom; None for the whole image."""
    clip: list = dataclasses.field(default_factory=lambda: [0.0, 1e10])
    """[start, end], metres along the optical axis."""
    solids: Path | None = None
    """An npz of corners [F, 3, 3], colour [F, 3] and holdout [F]."""
    background: list | None = None
    """[r, g, b], linear; None for a transparent background."""
    view: View = VIEWS[0]
    step: float = RAY_STEP
    """Metres between samples of a ray through humans of natural size; scaled humans are sampled in proportion."""

    def check(self) -> None:
        """See `RequestRecord`."""
        for person in self.people:
            person.check()
        check_sides(self.width, self.height)
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
        """Width and height of the drawn region."""
        return (self.width, self.height) if self.region is None else (self.region[2], self.region[3])

    @property
    def corner(self) -> tuple[int, int]:
        """The region's top left pixel in the whole image, from the left and top."""
        return (0, 0) if self.region is None else (self.region[0], self.height - self.region[1] - self.region[3])
