"""Blender's importers, one for each kind of file, with errors of one sentence."""

from __future__ import annotations

from pathlib import Path

import bpy

from .scan_files import ScanError


def import_file(path: Path) -> list[bpy.types.Object]:
    """Import a .glb, .gltf, .fbx or .obj into the scene; its objects. Raises ScanError where Blender cannot read it."""
    if not path.is_file():
        raise ScanError(f"there is no scan {path}: check the path")
    before = {thing.session_uid for thing in bpy.data.objects}
    importers = {".glb": _import_gltf, ".gltf": _import_gltf, ".fbx": _import_fbx, ".obj": _import_obj}
    try:
        importers[path.suffix.lower()](str(path))
    except Exception as e:  # importers written in Python let everything through, a damaged file's KeyError too
        raise ScanError(f"{path} cannot be imported: {_last_line(e)}; export it again") from e
    return [obj for obj in bpy.data.objects if obj.session_uid not in before]


def _import_gltf(path: str) -> None:
    bpy.ops.import_scene.gltf(filepath=path, disable_bone_shape=True, bone_heuristic="BLENDER")


def _import_fbx(path: str) -> None:
    try:
        bpy.ops.wm.fbx_import(filepath=path, use_anim=False)
    except RuntimeError:  # what the newer importer refuses the older one may read
        bpy.ops.import_scene.fbx(filepath=path, use_anim=False)


def _import_obj(path: str) -> None:
    bpy.ops.wm.obj_import(filepath=path)


def _last_line(error: Exception) -> str:
    """Of an importer's traceback the exception; Blender's operators add the place in their own code."""
    lines = [line.strip() for line in str(error).splitlines()]
    lines = [line for line in lines if line and not line.startswith("Location: ")]
    return (lines[-1] if lines else type(error).__name__).removeprefix("Error: ")
