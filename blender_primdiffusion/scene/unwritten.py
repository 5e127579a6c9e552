"""Volumes that are written after their human stands.

A human's volumes are objects with paths from the start. Where their files come later, the backend's human.npz is beside
them as `unwritten_<hash>.npz`, the hash being that of the files' names. Any Blender can write them from it, in steps
and after any interruption; it is removed with the last one.
"""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import bpy

from ..formats.removing import remove_file
from .human import MARK, folders_of, is_own, unwritten_in
from .human_npz import HumanNpzError, file_names, read_human, unwritten_name
from .newer_volumes import newer_volumes, write_again
from .volumes import bake, is_readable, write_error, write_one

_VERSIONS = ((5, 0, 0), (4, 5, 0))
"""Blender versions that write volumes differently."""


def unwritten() -> list[Path]:
    """Files from which volumes of this .blend's humans are still to be written, in its own folders.

    Those in other folders are for `collect.collect_unwritten`.
    """
    folders = {folders_of(person)[0] for person in bpy.data.collections if MARK in person}
    return [path for folder in sorted(folders) if is_own(folder) for path in unwritten_in(folder)]


def write_unwritten(source: Path) -> Generator[None, None, None]:
    """Write the volumes of `source` beside it, a file a step, and then remove it; volumes that exist stay.

    Several may write the same volumes, as a timer and a render do. Raises HumanNpzError and VolumeWriteError.
    """
    human = read_human(source)
    yield
    grids = bake(human.density, human.rgb, human.half_extent)
    yield
    for version in _VERSIONS:
        names = file_names(grids, version)
        yield
        if unwritten_name(names) == source.name:
            break
    else:
        raise HumanNpzError(f"{str(source)!r} was changed: press Find Missing Volumes after deleting it")
    paths = [source.parent / name for name in names]
    try:
        for k, path in enumerate(paths):
            if not is_readable(path):
                write_one(grids, k, version, path)
                yield
        remove_file(source, source.parent)
    except (OSError, RuntimeError) as error:  # openvdb reports a full disk as RuntimeError
        raise write_error(source.parent, error) from error


def write_all_unwritten() -> None:
    """Write what `unwritten` lists, and volumes in a newer format, which takes seconds for each human.

    Raises as `write_unwritten` and `newer_volumes.write_again`.
    """
    for source in unwritten():
        for _ in write_unwritten(source):
            pass
    for newer in newer_volumes():
        for _ in write_again(newer):
            pass
