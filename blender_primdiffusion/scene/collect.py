"""People generated before the first save have their volumes in a temporary folder; saving brings them along."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from .volumes import humans_folder


def collect_temporary_volumes(blend_path: str) -> int:
    """Copy volumes from the temporary folder to the one of `blend_path`, point to the copies, and count them.

    What else lies with them (the person's own file) is copied too. Paths become absolute: Blender makes them relative
    when it writes a .blend for the first time. Raises OSError when the folder beside the .blend cannot be written.
    """
    temporary, target = humans_folder(""), humans_folder(blend_path)
    moved = {}
    for volume in bpy.data.volumes:
        source = Path(bpy.path.abspath(volume.filepath))
        if source.is_relative_to(temporary) and source.is_file():
            moved[volume] = target / source.relative_to(temporary)
    for folder in {Path(bpy.path.abspath(volume.filepath)).parent for volume in moved}:
        destination = target / folder.relative_to(temporary)
        destination.mkdir(parents=True, exist_ok=True)
        for source in folder.iterdir():
            if source.is_file():
                unfinished = destination / f".{source.name}.part"
                shutil.copyfile(source, unfinished)
                os.replace(unfinished, destination / source.name)
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
