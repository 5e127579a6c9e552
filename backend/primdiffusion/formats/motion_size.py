"""How much motion a file may hold: a rotation takes 20 times as much memory as the numbers that it is made from.

Needs no numpy.
"""

from __future__ import annotations

import os
from pathlib import Path

from .regular_files import FileError

UNBACKED_NUMBERS = 4_000_000
"""Numbers of poses that a file may hold however small it is: 15 minutes of SMPL at 60 frames/s, standing still."""
NUMBERS_A_BYTE = 4
"""Numbers for each byte of the file beyond that. Recorded motion has at most one, since noise does not compress."""


def check_motion_size(path: str | Path, numbers: int) -> None:
    """Raise FileError for more `numbers` of poses than a file of this size may hold, and OSError."""
    most = max(UNBACKED_NUMBERS, NUMBERS_A_BYTE * os.stat(path).st_size)
    if numbers > most:
        reason = f"holds {numbers} numbers of poses, more than the {most} that a file of its size may have"
        raise FileError(path, reason, "cut the motion into pieces")
