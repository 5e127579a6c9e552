"""The VDB files of humans, a folder for each: a bake that Cycles and EEVEE draw, and that may be deleted.

They lie beside the human's own file in the temporary folder of this session (see `payload`). A .blend that comes from
another session, or from a stranger, names folders of its own: `open_humans` names this session's before anything is
read.
"""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import bpy

from ..files.whole_files import remove_abandoned
from .human import all_humans, body_of, write_error
from .payload import session_file
from .rest_human import read_human, shape_model_of
from .volume_nodes import FILES, hide_in_viewport, set_folder, volumes_of
from .volumes import write_volume


def open_humans() -> list[str]:
    """Point the volumes of all humans to the files of this session; returns what is wrong with humans, in sentences.

    For files that were opened and humans that were appended or linked, before undo takes note of them. A human whose
    data are missing or damaged shows its body mesh. Viewports hide volumes whose files are yet to be written: Blender
    would remember that they were missing (see `set_folder`).
    """
    faults = []
    for person in all_humans():
        try:
            folder = session_file(person).parent
            shape_model_of(person)
        except (ValueError, OSError) as error:
            faults.append(f"the human {person.name!r} cannot be drawn: {error}")
            if (body := body_of(person)) is not None:
                body.hide_viewport = False
            continue
        set_folder(person, folder)
        volumes = volumes_of(person)
        if volumes is not None and not volumes.hide_viewport and not are_written(person):
            hide_in_viewport(person, volumes)
    return faults


def files_of(person: bpy.types.Object) -> list[Path]:
    """Where the files of a human's volumes are, or will be. Raises as `session_file` and `shape_model_of`."""
    folder, count = session_file(person).parent, len(shape_model_of(person).face)
    return [folder / FILES.format(k) for k in range(count)]


def are_written(person: bpy.types.Object) -> bool:
    """Whether all files of a human's volumes are there. Raises as `files_of`."""
    return all(path.is_file() for path in files_of(person))


def writing(person: bpy.types.Object) -> Generator[None, None, None]:
    """Write the files of a human's volumes, one a step; those that are there stay. It holds no Blender objects, since
    undo may replace them. Raises as `read_human`, also for what cannot be written.
    """
    return _writing(session_file(person), files_of(person))


def _writing(source: Path, files: list[Path]) -> Generator[None, None, None]:
    grids = read_human(source).grids()
    yield
    remove_abandoned(source.parent)
    for k, path in enumerate(files):
        try:
            if not path.is_file():
                write_volume(grids, k, path)
        except (OSError, RuntimeError) as error:  # openvdb reports a full disk as RuntimeError
            raise write_error(source.parent, error) from error
        yield


def write_volumes(person: bpy.types.Object) -> None:
    """Write the files of a human's volumes, which takes seconds. Raises as `writing`."""
    if volumes_of(person) is not None and not are_written(person):
        for _ in writing(person):
            pass
