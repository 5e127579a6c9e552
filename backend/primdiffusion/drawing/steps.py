"""Limits on the distance between samples of a ray. Imports no torch."""

from __future__ import annotations

FINEST_STEP = 1e-4
"""Metres; a finer step takes hours without visible gain."""
COARSEST_STEP = 1.0


def check_step(step: float) -> None:
    """Raise ValueError if `step`, metres between samples of a ray, is out of range."""
    if not FINEST_STEP <= step <= COARSEST_STEP:
        raise ValueError(f"the step is {step} m: choose {FINEST_STEP} to {COARSEST_STEP}")
