"""Parameters of the jobs that make a person of a person, checked before any work starts. Imports no torch."""

from __future__ import annotations

import dataclasses

from primdiffusion.editing.shares import check_share
from primdiffusion.serve.params import check_attributes, check_picture_px, check_seed, check_size, check_steps

TRANSFERS = ("texture", "garment")


@dataclasses.dataclass(frozen=True, kw_only=True)
class EditParams:
    """What all these jobs are told."""

    person: str
    """Whom to edit: a .human.safetensors file, which stays as it is."""
    out_dir: str
    """Folder for the same files as those of generate; made if missing."""
    steps: int = 30
    checkpoint: str | None = None
    """A .safetensors file; None for the one that ships with the package."""
    size: int = 512
    """Pixels a side of the pictures."""
    picture_px: int = 0
    """Pixels a side of the pictures while the person is sampled; 0 for none."""

    def __post_init__(self) -> None:
        check_steps(self.steps)
        check_size(self.size)
        check_picture_px(self.picture_px)
        for name in ("person", "out_dir"):
            if not getattr(self, name):
                raise ValueError(f"{name} is empty: name a {'folder' if name == 'out_dir' else 'file'}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class VaryParams(EditParams):
    """Parameters of vary."""

    amount: float = 0.5
    seed: int = 0
    attributes: dict = dataclasses.field(default_factory=dict)
    guidance: float = 1.5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_share("amount", self.amount)
        check_seed(self.seed)
        check_attributes(self.attributes, self.guidance)


@dataclasses.dataclass(frozen=True, kw_only=True)
class InterpolateParams(EditParams):
    """Parameters of interpolate."""

    other: str
    """A second .human.safetensors file."""
    fraction: float = 0.5
    """0 is the person, 1 the other one."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_share("fraction", self.fraction)
        if self.steps < 2:
            raise ValueError(f"{self.steps} steps were asked for: an interpolation takes 2 or more")


@dataclasses.dataclass(frozen=True, kw_only=True)
class InpaintParams(EditParams):
    """Parameters of inpaint."""

    region: list | dict
    """Names of parts, or {"weights": path of an .npz with weights [V] painted on the vertices of human.npz}."""
    seed: int = 0
    attributes: dict = dataclasses.field(default_factory=dict)
    guidance: float = 1.5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_region(self.region)
        check_seed(self.seed)
        check_attributes(self.attributes, self.guidance)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TransferParams(EditParams):
    """Parameters of transfer; checkpoint, seed and steps are those of harmonising."""

    source: str
    """A .human.safetensors file: whose looks the person gets."""
    region: list | dict
    what: str = "texture"
    """"texture": colours alone, on the person's own shape; "garment": shape too."""
    harmonise: float = 0.0
    """0 copies exactly; up to 1, how much the region is then denoised so as to fit the rest."""
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_region(self.region)
        check_share("harmonise", self.harmonise)
        check_seed(self.seed)
        if self.what not in TRANSFERS:
            raise ValueError(f"there is no transfer of {self.what!r}: choose from {', '.join(TRANSFERS)}")


def check_region(region: list | dict) -> None:
    """ValueError unless it is a list of texts or {"weights": text}; which parts there are is known later."""
    texts = list(region.values()) if isinstance(region, dict) else region
    known = not isinstance(region, dict) or list(region) == ["weights"]
    if not (known and texts and all(isinstance(text, str) and text for text in texts)):
        raise ValueError(f'region is {region!r:.80}: give a list of names of parts, or {{"weights": path of an .npz}}')
