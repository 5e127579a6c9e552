"""Copies of people's files: whole or not at all, and never in the place of somebody else's."""

from __future__ import annotations

import filecmp
import hashlib
import os
import shutil
from pathlib import Path


def put_copy(source: Path, destination: Path) -> bool:
    """Copy a file, which appears whole or not at all; whether it was not there before. Raises OSError."""
    before = destination.exists()
    destination.parent.mkdir(parents=True, exist_ok=True)
    unfinished = destination.with_name(f".{source.name}.part")
    try:
        shutil.copyfile(source, unfinished)
        os.replace(unfinished, destination)
    finally:
        unfinished.unlink(missing_ok=True)
    return not before


def named_by_content(person: Path) -> str:
    """A name for the backend's file of a person that no other content has."""
    return f"person_{hashlib.sha256(person.read_bytes()).hexdigest()[:12]}.human.safetensors"


def free_name(person: Path, folder: Path, name: str) -> str:
    """The name under which the backend's file of a person may be put into `folder`: `name`, unless that is taken by
    somebody else, whom undo may bring back."""
    taken = folder / name
    if not taken.is_file() or filecmp.cmp(person, taken, shallow=False):
        return name
    return named_by_content(person)
