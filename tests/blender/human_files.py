"""A human's data, and where its files are on the disk in this session."""

import shutil
from pathlib import Path

import bpy

from blender_primdiffusion.jobs.parts import complete_humans
from blender_primdiffusion.scene.human import BODY, PAYLOAD, parts_of, session_file, session_folder
from blender_primdiffusion.scene.volume_nodes import files_of


def person_file(person: bpy.types.Object) -> Path:
    """The human's own file, written from the .blend."""
    return session_file(person)


def folder_of(person: bpy.types.Object) -> Path:
    """The folder of the human's files, volumes among them."""
    return session_file(person).parent


def held(person: bpy.types.Object) -> tuple[bytes, bytes]:
    """The human's file and its body's, as they are packed."""
    return tuple(person[name].packed_file.data for name in (PAYLOAD, BODY))


def paths_of(person: bpy.types.Object) -> list[Path]:
    """The files of the human's volumes, there or not."""
    return files_of(person)


def volume_path(volume: bpy.types.Volume) -> Path:
    """What a volume shows."""
    return Path(bpy.path.abspath(volume.filepath, library=volume.library))


def sequence_files(volume: bpy.types.Volume) -> list[Path]:
    """All files of a merged volume."""
    path = volume_path(volume)
    return sorted(path.parent.glob(path.name.replace("_0001.vdb", "_*.vdb")))


def lose_data(person: bpy.types.Object) -> None:
    """Leave the human without its packed file."""
    del person[PAYLOAD]


def forget_session_files() -> None:
    """Remove the files of this session; those that are needed again are written again."""
    shutil.rmtree(session_folder(), ignore_errors=True)


def remove_human(person: bpy.types.Object) -> None:
    """Remove the human and all its parts."""
    bpy.data.batch_remove(parts_of(person))


def copy_of(person: bpy.types.Object) -> bpy.types.Object:
    """A copy by Blender's Shift-D of the armature, with parts of its own."""
    for obj in bpy.context.selected_objects:
        obj.select_set(False)
    person.select_set(True)
    bpy.context.view_layer.objects.active = person
    bpy.ops.object.duplicate()
    complete_humans()
    return bpy.context.view_layer.objects.active


def press_x(person: bpy.types.Object) -> None:
    """Delete the armature as Blender's X does, and what goes with it."""
    for obj in bpy.context.selected_objects:
        obj.select_set(False)
    person.select_set(True)
    bpy.ops.object.delete()
    complete_humans()
