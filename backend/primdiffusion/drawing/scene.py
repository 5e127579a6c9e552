"""What a picture shows and how: the nouns of drawing."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float32, Int
from numpy import ndarray
from torch import Tensor

from primdiffusion.formats.requests import VIEWS, View
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.march import MarchSettings
from primdiffusion.render.solids import Solids

NOTHING = 1e10
"""Depth where there is nothing, metres: what Blender's Depth pass holds there."""


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """People and opaque things in the world."""

    primitives: Primitives | None
    """All people's boxes, unbatched (`Primitives.together`); None without people."""
    solids: Solids | None = None
    chart: Int[Tensor, "k"] | None = None
    """Which region of a body each box belongs to; the view "boxes" gives regions their hues."""


@dataclasses.dataclass(frozen=True)
class Look:
    """How a scene is drawn."""

    view: View = VIEWS[0]
    background: tuple[float, float, float] | None = None
    """Linear RGB behind everything; None leaves the picture transparent there."""
    clip: tuple[float, float] = (0.0, math.inf)
    """Depths along the optical axis, metres, between which anything is seen."""
    settings: MarchSettings = MarchSettings()  # noqa: RUF009  frozen

    def __post_init__(self) -> None:
        """ValueError for an unknown view and planes in the wrong order."""
        if self.view not in VIEWS:
            raise ValueError(f"there is no view {self.view!r}; choose from {', '.join(VIEWS)}")
        start, end = self.clip
        if not 0 <= start < end:
            raise ValueError(
                f"the clip distances are {start} and {end} m: the end must lie behind the start, from 0 on"
            )


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """What was drawn, or room for it; top row first. Its arrays may be views into a file."""

    combined: Float32[ndarray, "h w 4"]
    """Linear RGB, premultiplied by alpha, and alpha."""
    depth: Float32[ndarray, "h w"]
    """Metres along the optical axis to where opacity reaches one half; NOTHING where it never does."""

    @classmethod
    def blank(cls, width: int, height: int) -> Picture:
        """A transparent picture."""
        return cls(np.zeros((height, width, 4), np.float32), np.full((height, width), NOTHING, np.float32))

    def rows(self, top: int, bottom: int) -> Picture:
        """The rows from `top` up to `bottom`; writing to them writes to this picture."""
        return Picture(self.combined[top:bottom], self.depth[top:bottom])
