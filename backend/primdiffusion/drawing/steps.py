"""How far apart a picture's samples may be asked to lie. Imports no torch."""

from __future__ import annotations

FINEST_STEP = 1e-4
"""Metres; finer, a picture takes hours and gains nothing."""
COARSEST_STEP = 1.0


def check_step(step: float) -> None:
    """ValueError for a step, metres between the samples of a ray, that no picture of a person wants."""
    if not FINEST_STEP <= step <= COARSEST_STEP:
        raise ValueError(f"the step is {step} m: choose {FINEST_STEP} to {COARSEST_STEP}")
