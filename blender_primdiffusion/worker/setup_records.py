"""Whether installed packages are as their wheels had them: each file against its line in the package's RECORD."""

from __future__ import annotations

import base64
import csv
import hashlib
from pathlib import Path


def damaged(environment: Path) -> str | None:
    """What is wrong first, in a sentence; None: every recorded file is there with its hash. Reads all of them."""
    records = sorted(environment.glob("lib*/python*/site-packages/*.dist-info/RECORD"))
    records += sorted(environment.glob("Lib/site-packages/*.dist-info/RECORD"))
    if not records:
        return f"{environment} holds no packages"
    for record in records:
        site_packages = record.parent.parent
        with record.open(encoding="utf-8", newline="") as file:
            for name, digest, _ in csv.reader(file):
                if digest and not _as_recorded(site_packages / name, digest):
                    return f"{name} is not as it was installed"
    return None


def _as_recorded(path: Path, digest: str) -> bool:
    algorithm, _, expected = digest.partition("=")
    try:
        with path.open("rb") as file:
            found = hashlib.file_digest(file, algorithm).digest()
    except (OSError, ValueError):
        return False
    return base64.urlsafe_b64encode(found).rstrip(b"=").decode() == expected
