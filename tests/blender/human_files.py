"""Where a human's files are on the disk in this session."""

from __future__ import annotations

from pathlib import Path

import bpy

from blender_primdiffusion.scene.human import armature_of, volumes_of
from blender_primdiffusion.scene.payload import PAYLOAD, session_file


def person_file(person: bpy.types.Collection) -> Path:
    """The human's own file, written from the .blend."""
    return session_file(armature_of(person))


def folder_of(person: bpy.types.Collection) -> Path:
    """The folder of the human's files, volumes among them."""
    return person_file(person).parent


def paths_of(person: bpy.types.Collection) -> list[Path]:
    """What the human's volumes show."""
    return [Path(obj.data.filepath) for objects in volumes_of(person).values() for obj in objects]


def volume_path(volume: bpy.types.Volume) -> Path:
    """What a volume shows."""
    return Path(bpy.path.abspath(volume.filepath, library=volume.library))


def sequence_files(volume: bpy.types.Volume) -> list[Path]:
    """All files of a merged volume."""
    path = volume_path(volume)
    return sorted(path.parent.glob(path.name.replace("_0001.vdb", "_*.vdb")))


def lose_data(person: bpy.types.Collection) -> None:
    """Leave the human without its packed file."""
    del armature_of(person)[PAYLOAD]
