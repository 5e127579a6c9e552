"""What is in the open .blend, for tests of what leaves it as it was."""

import bpy

_BLENDER_LISTS = {"window_managers", "workspaces", "screens", "texts", "palettes", "brushes", "libraries", "all_ids"}
"""Blender's own, or where an operator says something. A linked person's library is one of theirs."""


def everything() -> dict[str, set[str]]:
    kinds = [prop.identifier for prop in bpy.data.bl_rna.properties if prop.type == "COLLECTION"]
    return {kind: {obj.name_full for obj in getattr(bpy.data, kind)} for kind in kinds if kind not in _BLENDER_LISTS}


def state() -> tuple:
    """What a rejected operator must leave as it was."""
    active = bpy.context.view_layer.objects.active
    selected = sorted(obj.name for obj in bpy.context.view_layer.objects.selected)
    places = {obj.name: [list(row) for row in obj.matrix_basis] for obj in bpy.data.objects}
    paths = {volume.name: volume.filepath for volume in bpy.data.volumes}
    marks = {c.name: {key: str(c[key]) for key in c.keys()} for c in bpy.data.objects}  # noqa: SIM118
    return everything(), active and (active.name, active.mode), selected, places, paths, marks
