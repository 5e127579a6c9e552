"""How much memory another process holds."""

from __future__ import annotations

import os
import subprocess


def resident_bytes(pid: int) -> int | None:
    """Of physical memory; None where the system does not tell (Windows), or the process is gone."""
    if os.name == "nt":
        return None
    try:
        told = subprocess.run(["ps", "-o", "rss=", "-p", str(pid)], capture_output=True, timeout=1.0, check=True)
        return int(told.stdout) * 1024
    except (OSError, subprocess.SubprocessError, ValueError):
        return None
