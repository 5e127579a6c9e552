"""Objects on the GPU that are made once and freed in time."""

from __future__ import annotations

import atexit
import functools
from collections.abc import Callable
from typing import TypeVar

Made = TypeVar("Made")


def cache_until_exit(make: Callable[[], Made]) -> Callable[[], Made]:
    """As `functools.cache`, for functions that make objects on the GPU: emptied when Python exits.

    Blender 5.2 as a module frees its GPU before Python frees what modules still hold, and crashes.
    """
    cached = functools.cache(make)
    atexit.register(cached.cache_clear)
    return cached
