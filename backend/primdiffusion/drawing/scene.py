"""Records for drawing: the scene, the view settings and the resulting picture."""

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
"""Depth of the background, metres, as in Blender's Depth pass."""


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Humans and opaque meshes in world space."""

    primitives: Primitives | None
    """Primitives of all humans, unbatched (`Primitives.together`); None if there are none."""
    solids: Solids | None = None
    chart: Int[Tensor, "k"] | None = None
    """The body region of each primitive; sets its hue in the view "boxes"."""


@dataclasses.dataclass(frozen=True)
class ViewSettings:
    """View settings."""

    view: View = VIEWS[0]
    background: tuple[float, float, float] | None = None
    """Linear RGB; None is transparent."""
    clip: tuple[float, float] = (0.0, math.inf)
    """Near and far clipping depths along the optical axis, metres."""
    settings: MarchSettings = MarchSettings()  # noqa: RUF009  frozen

    def __post_init__(self) -> None:
        """Raise ValueError for an unknown view or clip planes in the wrong order."""
        if self.view not in VIEWS:
            raise ValueError(f"unknown view {self.view!r}; choose from {', '.join(VIEWS)}")
        start, end = self.clip
        if not 0 <= start < end:
            raise ValueError(f"the clip distances are {start} and {end} m: give a start of at least 0 and a larger end")


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """An image buffer, top row first. The arrays may be memory-mapped."""

    combined: Float32[ndarray, "h w 4"]
    """Linear RGB, premultiplied by alpha, and alpha."""
    depth: Float32[ndarray, "h w"]
    """Metres along the optical axis to where opacity reaches one half; NOTHING if it never does."""

    @classmethod
    def blank(cls, width: int, height: int) -> Picture:
        """An empty, transparent picture."""
        return cls(np.zeros((height, width, 4), np.float32), np.full((height, width), NOTHING, np.float32))

    def rows(self, top: int, bottom: int) -> Picture:
        """A view of the rows `top` to `bottom` (exclusive); writing to it writes to this picture."""
        return Picture(self.combined[top:bottom], self.depth[top:bottom])
