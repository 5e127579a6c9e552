"""Parameters of the jobs the child runs, checked before any work starts. Imports no torch."""

from __future__ import annotations

import dataclasses
import math

LARGEST_SEED = 2**63 - 1
STEP_LIMIT = 1000
"""The schedule's length: a sampler cannot take more steps."""
LARGEST_STEP_PICTURE = 1024
"""Pixels a side: a larger picture would hold up the work, and cancelling."""


@dataclasses.dataclass(frozen=True)
class GenerateParams:
    """Parameters of generate."""

    seed: int
    out_dir: str
    """Folder for human.npz, person.human.safetensors and pictures; made if missing."""
    steps: int = 30
    sampler: str = "ddim"
    checkpoint: str | None = None
    """A .safetensors file; None for the one that ships with the package."""
    size: int = 512
    """Pixels a side of the pictures."""
    attributes: dict = dataclasses.field(default_factory=dict)
    """What the person shall be: texts and numbers by name, of those that `attributes` tells."""
    guidance: float = 1.5
    """How strongly attributes are insisted on: 1 plainly, more at the cost of variety."""
    picture_px: int = 0
    """Pixels a side of the pictures while the person is sampled; 0 for none."""

    def __post_init__(self) -> None:
        check_seed(self.seed)
        check_steps(self.steps)
        check_size(self.size)
        check_picture_px(self.picture_px)
        check_attributes(self.attributes, self.guidance)
        if not self.out_dir:
            raise ValueError("out_dir is empty: name a folder")


@dataclasses.dataclass(frozen=True)
class AttributesParams:
    """Parameters of attributes."""

    checkpoint: str | None = None
    """A .safetensors file; None for the one that ships with the package."""


@dataclasses.dataclass(frozen=True)
class ReconstructParams:
    """Parameters of reconstruct."""

    capture: str
    """Folder of a dataset of captures, or of one subject in it."""
    out_dir: str
    """Folder for the same files as those of generate; made if missing."""
    subject: str | None = None
    """Whom; None where there is only one."""
    frame: int = 0
    views: int = 8
    """Cameras spread around the person; all where there are fewer."""
    checkpoint: str | None = None
    """An encoder's .safetensors file; None for the one that ships with the package."""
    size: int = 512
    """Pixels a side of the pictures."""

    def __post_init__(self) -> None:
        if self.frame < 0:
            raise ValueError(f"frame {self.frame}: they are counted from 0")
        if self.views < 1:
            raise ValueError(f"{self.views} views were asked for: the encoder needs one or more")
        check_size(self.size)
        for name in ("capture", "out_dir"):
            if not getattr(self, name):
                raise ValueError(f"{name} is empty: name a folder")


@dataclasses.dataclass(frozen=True)
class RenderParams:
    """Parameters of render."""

    human: str
    """A person.human.safetensors file."""
    out: str
    """The PNG to write."""
    width: int = 512
    height: int = 512
    yaw: float = 0.0
    """Where the camera stands around the person: 0 in front, pi/2 at the person's left; radians."""
    pose: str | list | None = None
    """72 axis-angle values (24 x 3, radians), or a pose file (.json, .npz); None for the T pose."""
    depth: str | None = None
    """A second PNG, of depth."""

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 1:
            raise ValueError(f"a picture of {self.width} x {self.height} pixels: choose sides of 1 or more")
        if not math.isfinite(self.yaw):
            raise ValueError(f"yaw is {self.yaw}: give an angle in radians")


def check_seed(seed: int) -> None:
    """ValueError outside 0 ... 2^63-1."""
    if not 0 <= seed <= LARGEST_SEED:
        raise ValueError(f"seed {seed} is outside 0 ... 2^63-1")


def check_steps(steps: int) -> None:
    """ValueError outside 1 ... STEP_LIMIT."""
    if not 1 <= steps <= STEP_LIMIT:
        raise ValueError(f"{steps} steps were asked for: choose 1 to {STEP_LIMIT}")


def check_size(size: int) -> None:
    """ValueError for a picture without pixels."""
    if size < 1:
        raise ValueError(f"pictures of {size} pixels a side: choose 1 or more")


def check_picture_px(picture_px: int) -> None:
    """ValueError outside 0 ... LARGEST_STEP_PICTURE."""
    if not 0 <= picture_px <= LARGEST_STEP_PICTURE:
        raise ValueError(f"picture_px is {picture_px}: choose 0, for no pictures, to {LARGEST_STEP_PICTURE}")


def check_attributes(attributes: dict, guidance: float) -> None:
    """ValueError unless the values are texts and finite numbers; which ones there are, the checkpoint knows."""
    for name, value in attributes.items():
        number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if not (isinstance(value, str) or number):
            raise ValueError(f"the attribute {name!r} is {value!r:.40}: give a text or a number")
    if not math.isfinite(guidance):
        raise ValueError(f"guidance is {guidance}: give a number, 1 for none")
