"""Work that yields while it waits, done at once by callers that have nothing else to do: commands and tests."""

from __future__ import annotations

import time
from collections.abc import Generator
from typing import TypeVar

TICK_S = 0.02

Result = TypeVar("Result")


def run_to_end(work: Generator[object, None, Result]) -> Result:
    """What `work` returns; sleeps at each of its yields. Raises what it raises."""
    while True:
        try:
            next(work)
        except StopIteration as done:
            return done.value
        time.sleep(TICK_S)
