"""Parameters of the jobs that hand a person to other programs, checked before any work starts. Imports no torch."""

from __future__ import annotations

import dataclasses

from primdiffusion.serve.draw_params import JOINTS, check_numbers
from primdiffusion.serve.params import check_size


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProxyParams:
    """Parameters of proxy."""

    person: str
    """A .human.safetensors file."""
    out_dir: str
    """Folder for proxy.npz and proxy.png; made if missing."""
    betas: list | None = None
    """Shape coefficients; None for the file's."""
    triangles: int = 20_000
    """At most."""
    texture_px: int = 2048
    """Pixels a side of proxy.png."""
    spacing: float = 0.006
    """Of the grid that the surface is found on, metres."""

    def __post_init__(self) -> None:
        check_given(self, "person", "out_dir")
        check_betas(self.betas)


@dataclasses.dataclass(frozen=True, kw_only=True)
class GaussiansParams:
    """Parameters of gaussians."""

    person: str
    """A .human.safetensors file."""
    out: str
    """The .ply to write."""
    object: list | None = None
    """[3][4] world matrix of the armature object; y up, metres. None, as `joints`: the T pose at the origin."""
    joints: list | None = None
    """[24][3][4] from rest to posed in the object's space, SMPL's joint order."""
    betas: list | None = None
    """Shape coefficients; None for the file's."""
    limit: int = 400_000
    """Gaussians at most."""

    def __post_init__(self) -> None:
        check_given(self, "person", "out")
        check_betas(self.betas)
        if (self.object is None) != (self.joints is None):
            raise ValueError("object and joints go together: give both, or neither for the T pose")
        if self.object is not None:
            check_numbers("object", self.object, (3, 4))
            check_numbers("joints", self.joints, (JOINTS, 3, 4))
        if self.limit < 1:
            raise ValueError(f"{self.limit} Gaussians were asked for: choose 1 or more")


@dataclasses.dataclass(frozen=True, kw_only=True)
class HumanNpzParams:
    """Parameters of human_npz."""

    person: str
    """A .human.safetensors file."""
    out_dir: str
    """Folder for the same files as those of generate; made if missing."""
    size: int = 512
    """Pixels a side of the pictures."""

    def __post_init__(self) -> None:
        check_given(self, "person", "out_dir")
        check_size(self.size)


def check_given(params: object, *names: str) -> None:
    """ValueError for an empty path."""
    for name in names:
        if not getattr(params, name):
            raise ValueError(f"{name} is empty: name a {'folder' if name == 'out_dir' else 'file'}")


def check_betas(betas: list | None) -> None:
    """ValueError unless it is a list of numbers, or None."""
    if betas is not None:
        check_numbers("betas", betas, (len(betas),))
