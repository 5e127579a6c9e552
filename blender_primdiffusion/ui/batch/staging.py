"""Folders and pictures that are there whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ...formats.capture_layout import replacing


@contextmanager
def staging(folder: Path) -> Iterator[Path]:
    """An empty folder beside `folder`, to be published; gone after the block, and first if a killed run left one."""
    made = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir(parents=True)
    try:
        yield made
    finally:
        shutil.rmtree(made, ignore_errors=True)


def publish(made: Path, folder: Path, last: str) -> None:
    """Give what is in `made` to `folder`: at once where that is new, else piece by piece, the file `last` last."""
    if not folder.exists():
        os.replace(made, folder)
        return
    for piece in sorted(made.iterdir(), key=lambda path: path.name == last):
        target = folder / piece.name
        if target.is_dir():
            shutil.rmtree(target)
        os.replace(piece, target)


def claim(path: Path, settings: Mapping[str, Any], whatever_is_there: bool) -> None:
    """Write the settings of a batch to the .json at `path`. Raises ValueError where other ones are there, and OSError.

    `whatever_is_there`: the settings are then those of what is still to come.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(path.parent, error) from error
    wanted = json.loads(json.dumps(settings))
    if path.is_file() and not whatever_is_there:
        try:
            there = dict(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} is damaged ({error}): choose another folder, or add --resume") from error
        for name in sorted({*wanted, *there}):
            if there.get(name) != wanted.get(name):
                raise ValueError(
                    f"what is in {path.parent} was made with {name} = {there.get(name)}, not {wanted.get(name)}: "
                    "choose another folder, or add --resume to keep it"
                )
    try:
        with replacing(path) as unfinished:
            unfinished.write_text(json.dumps(wanted, indent=1), encoding="utf-8")
    except OSError as error:
        raise _unwritable(path.parent, error) from error


def _unwritable(folder: Path, error: OSError) -> OSError:
    return OSError(f"nothing can be written to {folder} ({error.strerror or error}): choose another folder with --out")
