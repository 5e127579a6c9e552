"""What operators that sample people have in common: what a script does not give is the panel's."""

from __future__ import annotations

from typing import Any

import bpy

from .attributes import asked, parsed
from .settings import LARGEST_SEED, SAMPLER_ITEMS

_PANELS = "Not given: the panel's"
_SKIP = {"SKIP_SAVE"}


class Asking:
    """Properties of such operators. None is redoable: moving a redo slider must not start an expensive job again."""

    bl_options: set[str] = set()  # noqa: RUF012  bpy wants a plain set; neither REGISTER (redo) nor UNDO (the result has one)

    seed: bpy.props.IntProperty(
        name="Seed", default=-1, min=-1, max=LARGEST_SEED, description="-1: the panel's", options=_SKIP
    )
    steps: bpy.props.IntProperty(name="Steps", default=0, min=0, max=1000, description="0: the panel's", options=_SKIP)
    sampler: bpy.props.EnumProperty(name="Sampler", items=SAMPLER_ITEMS, description=_PANELS, options=_SKIP)
    guidance: bpy.props.FloatProperty(name="Guidance", min=0.0, max=20.0, description=_PANELS, options=_SKIP)
    attributes: bpy.props.StringProperty(
        name="Attributes",
        description="Like sex=female, height=1.7; empty: whatever comes. Not given: the panel's",
        options=_SKIP,
    )

    def given(self, name: str) -> bool:
        """Whether a script or a button has said it."""
        return self.properties.is_property_set(name)

    def sampling(self, settings: bpy.types.PropertyGroup) -> dict[str, Any]:
        """Fields steps, sampler and asked of a work. Raises ValueError for attributes that are no name=value."""
        wanted = parsed(self.attributes) if self.given("attributes") else asked(settings.attributes)
        guidance = self.guidance if self.given("guidance") else settings.guidance
        return {
            "steps": self.steps or settings.steps,
            "sampler": self.sampler if self.given("sampler") else settings.sampler,
            "asked": {"attributes": wanted, "guidance": guidance} if wanted else {},
        }


def last_seed(seed: int, count: int) -> int:
    """Of `count` seeds that follow on each other. Raises ValueError beyond LARGEST_SEED."""
    last = seed + count - 1
    if last > LARGEST_SEED:
        raise ValueError(f"{count} seeds from {seed} on go beyond {LARGEST_SEED}: choose a smaller seed")
    return last
