"""The poses to choose from, with their pictures; nothing is read before the panel is drawn for the first time."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.utils import previews

from ...motion.own_poses import own_poses
from ...places import own_folder

_PICTURES = Path(__file__).parents[2] / "motion" / "data" / "thumbnails"
_collections: list = []
"""Of previews: one, while there is one."""
_items: list[tuple[str, str, str, int, int]] = []
"""Blender keeps no reference to the texts of an enumeration, so we must."""


def poses_folder() -> Path:
    """Where the user's own poses are."""
    return own_folder() / "poses"


def pose_items(_self, _context: bpy.types.Context) -> list[tuple[str, str, str, int, int]]:
    """Built-in poses first, then the user's own."""
    from ...motion.library_poses import LIBRARY

    own = own_poses(poses_folder())
    wanted = [*LIBRARY, *(name for name in own if name not in LIBRARY)]
    if [item[0] for item in _items] != wanted:
        _items[:] = [
            (name, name, "A pose of your own" if name in own else "A built-in pose", _icon(name, name in own), number)
            for number, name in enumerate(wanted)
        ]
    return _items


def _icon(name: str, own: bool) -> int:
    if own:
        return bpy.types.UILayout.bl_rna.functions["prop"].parameters["icon"].enum_items["ARMATURE_DATA"].value
    if not _collections:
        _collections.append(previews.new())
    kept = _collections[0]
    if name not in kept:
        kept.load(name, str(_PICTURES / f"{name}.png"), "IMAGE")
    return kept[name].icon_id


def free() -> None:
    """Give the pictures back."""
    _items.clear()
    while _collections:
        previews.remove(_collections.pop())
