"""The poses to choose from, with their pictures; nothing is read before the panel is drawn for the first time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import bpy
from bpy.utils import previews

from ..motion.own_poses import own_poses, picture_of
from ..places import own_folder

if TYPE_CHECKING:
    from numpy.typing import NDArray

_PICTURES = Path(__file__).parents[1] / "motion" / "data" / "thumbnails"
_collections: list = []
"""Of previews: one, while there is one."""
_items: list[tuple[str, str, str, int, int]] = []
"""Blender keeps no reference to the texts of an enumeration, so we must."""


def poses_folder() -> Path:
    """Where the user's own poses are."""
    return own_folder() / "poses"


def pose_items(_self, _context: bpy.types.Context) -> list[tuple[str, str, str, int, int]]:
    """Built-in poses first, then the user's own."""
    from ..motion.poses import LIBRARY

    own = own_poses(poses_folder())
    wanted = [*LIBRARY, *(name for name in own if name not in LIBRARY)]
    if [item[0] for item in _items] != wanted:
        built_in = [
            (name, name, "A built-in pose", _icon(_PICTURES / f"{name}.png"), number)
            for number, name in enumerate(LIBRARY)
        ]
        _items[:] = built_in + [
            (name, name, "A pose of your own", _icon(picture_of(own[name])), _number(name))
            for name in wanted[len(LIBRARY) :]
        ]
    return _items


def draw_picture(pose: Path, rotations: NDArray) -> None:
    """Draw the picture of a pose of the user's own, in joint rotations [24, 3, 3], beside its file. Raises OSError."""
    import numpy as np

    from ..formats.picture_files import write_png
    from ..jobs.thumbnails import clay_figure
    from ..motion.skeleton import joint_positions

    picture = clay_figure(joint_positions(np.asarray(rotations)))[::-1]  # PNG files begin with the top row
    write_png(picture_of(pose), np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8))


def look_again() -> None:
    """A pose was saved or deleted: its name may have had another picture."""
    _items.clear()


def _number(name: str) -> int:
    """What a .blend keeps of the choice: of the name alone, for others come and go, and beyond the built-in ones'."""
    import zlib

    return zlib.crc32(name.encode()) & 0x3FFFFFFF | 0x40000000


def _icon(picture: Path) -> int:
    try:
        key = f"{picture} {picture.stat().st_mtime_ns}"
    except OSError:  # a pose that was saved before there were pictures, or brought without
        return bpy.types.UILayout.bl_rna.functions["prop"].parameters["icon"].enum_items["ARMATURE_DATA"].value
    if not _collections:
        _collections.append(previews.new())
    kept = _collections[0]
    if key not in kept:
        kept.load(key, str(picture), "IMAGE")
    return kept[key].icon_id


def free() -> None:
    """Give the pictures back."""
    _items.clear()
    while _collections:
        previews.remove(_collections.pop())
