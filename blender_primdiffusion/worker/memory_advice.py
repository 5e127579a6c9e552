"""What to lower when the memory did not suffice: which settings of a request cost memory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_SETTINGS = {
    "views": "lower Views",
    "seeds": "lower Count",
    "voxel": "raise Voxel Size",
    "width": "lower the resolution",
}
"""By the parameter of the child's method that they become."""


def memory_advice(params: Mapping[str, Any]) -> str:
    """What to do, of the request that asked for too much; the number of steps takes time and no memory."""
    lower = [advice for name, advice in _SETTINGS.items() if name in params]
    lower.append("close other programs" if lower else "choose a smaller Checkpoint in the preferences")
    steps = " (fewer Steps would not help)" if "steps" in params else ""
    return f"{', or '.join(lower)}{steps}"
