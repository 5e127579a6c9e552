"""Records for drawing: the scene and the view settings."""

from __future__ import annotations

import dataclasses
import math

from jaxtyping import Int
from torch import Tensor

from primdiffusion.formats.requests import VIEWS, View
from primdiffusion.primitives.primitives import Primitives
from primdiffusion.render.march import MarchSettings
from primdiffusion.render.solids import Solids

NOTHING = 1e10
"""Depth of the background in drawn images, metres, as in Blender's Depth pass."""


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
