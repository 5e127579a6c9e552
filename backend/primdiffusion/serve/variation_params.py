"""Parameters of variations, checked before any work starts. Imports no torch."""

from __future__ import annotations

import dataclasses

from primdiffusion.editing.shares import check_share
from primdiffusion.serve.params import check_attributes, check_picture_px, check_seed, check_steps

MOST_VARIATIONS = 64
"""They are sampled together: memory grows with their number."""


@dataclasses.dataclass(frozen=True)
class VariationsParams:
    """Parameters of variations."""

    seeds: list
    """Whom: whole numbers, no two alike."""
    out_dir: str
    """Folder for three files of each: SEED.human.npz, SEED.human.safetensors and SEED.png; made if missing."""
    steps: int = 30
    sampler: str = "ddim"
    checkpoint: str | None = None
    """A .safetensors file; None for the one that ships with the package."""
    size: int = 256
    """Pixels a side of the pictures."""
    attributes: dict = dataclasses.field(default_factory=dict)
    guidance: float = 1.5
    person: str | None = None
    """A .human.safetensors file: variants of this person, as `vary` makes them, instead of new people."""
    amount: float = 0.5
    """How far variants of a person go, as of `vary`."""

    def __post_init__(self) -> None:
        if not 1 <= len(self.seeds) <= MOST_VARIATIONS:
            raise ValueError(f"{len(self.seeds)} seeds were given: choose 1 to {MOST_VARIATIONS}")
        for seed in self.seeds:
            if not isinstance(seed, int) or isinstance(seed, bool):
                raise ValueError(f"the seed {seed!r:.40} is no whole number: give numbers of 0 ... 2^63-1")
            check_seed(seed)
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError("two of the seeds are alike, which would be one person twice: give each once")
        check_steps(self.steps)
        check_picture_px(self.size)
        if self.size < 2:
            raise ValueError(f"pictures of {self.size} pixels a side: choose 2 or more")
        check_attributes(self.attributes, self.guidance)
        check_share("amount", self.amount)
        if not self.out_dir or self.person == "":
            raise ValueError(f"{'person' if self.out_dir else 'out_dir'} is empty: name a file or folder")
