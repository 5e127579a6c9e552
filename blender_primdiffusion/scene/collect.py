"""People generated before the first save have their volumes in a temporary folder; saving brings them along."""

from __future__ import annotations

import os
import shutil

import bpy
from bpy.app.handlers import persistent

from .human import people_files, volume_path
from .merged import sequence_files
from .shape_file import body_files
from .volumes import humans_folder


def collect_temporary_volumes(blend_path: str) -> int:
    """Copy volumes from the temporary folder to the one of `blend_path`, point to the copies, and count them.

    The people's own files go along; what the .blend does not use stays behind, for undo. Paths become absolute: Blender
    makes them relative when it writes a .blend for the first time. Raises OSError when the folder beside the .blend
    cannot be written.
    """
    temporary, target = humans_folder(""), humans_folder(blend_path)
    moved = {}
    for volume in bpy.data.volumes:
        source = volume_path(volume)
        if source.is_relative_to(temporary) and source.is_file():
            moved[volume] = target / source.relative_to(temporary)
    sources = {path for volume in moved for path in sequence_files(volume)}
    folders = {path.parent for path in sources}
    places = [(folders, people_files()), ({folder.parent for folder in folders}, body_files())]
    for near, names in places:
        sources |= {folder / name for folder in near for name in names if (folder / name).is_file()}
    for source in sources:
        destination = target / source.relative_to(temporary)
        destination.parent.mkdir(parents=True, exist_ok=True)
        unfinished = destination.with_name(f".{source.name}.part")
        shutil.copyfile(source, unfinished)
        os.replace(unfinished, destination)
    for volume, path in moved.items():
        volume.filepath = str(path)
    return len(moved)


@persistent
def collect_before_saving(blend_path: str, *_: object) -> None:
    """Handler of save_pre. After a failure, printed, the .blend is saved pointing to the temporary files."""
    if not blend_path:  # the start-up file
        return
    try:
        collect_temporary_volumes(blend_path)
    except OSError as error:
        print(
            f"PrimDiffusion: volumes stay in {humans_folder('')}: they could not be copied beside the .blend ({error})"
        )
