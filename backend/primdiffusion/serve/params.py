"""Parameters of the jobs the child runs, checked before any work starts. Imports no torch."""

from __future__ import annotations

import dataclasses
import math

LARGEST_SEED = 2**63 - 1
STEP_LIMIT = 1000
"""The schedule's length: a sampler cannot take more steps."""


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

    def __post_init__(self) -> None:
        if not 0 <= self.seed <= LARGEST_SEED:
            raise ValueError(f"seed {self.seed} is outside 0 ... 2^63-1")
        if not 1 <= self.steps <= STEP_LIMIT:
            raise ValueError(f"{self.steps} steps were asked for: choose 1 to {STEP_LIMIT}")
        if self.size < 1:
            raise ValueError(f"pictures of {self.size} pixels a side: choose 1 or more")
        if not self.out_dir:
            raise ValueError("out_dir is empty: name a folder")


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
        if self.size < 1:
            raise ValueError(f"pictures of {self.size} pixels a side: choose 1 or more")
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
