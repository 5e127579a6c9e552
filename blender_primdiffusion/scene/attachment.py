"""What shows a human: volumes that follow the armature, or lie on the posed surface, or are merged; or its splats."""

from __future__ import annotations

import bpy

from .blend_values import stored_choice, stored_flag
from .human import check_editable
from .merged import merged_of
from .splats import SPLATS_AVAILABLE, splats_in
from .surface import build_surface, carrier_of, primitives_of

ATTACHMENT = "primdiffusion_attachment"
"""Custom property of a human's collection: one of MODES; ARMATURE where it is missing."""
MODES = ("ARMATURE", "SURFACE", "MERGED", "SPLATS")
_BEFORE = "primdiffusion_attachment_before_merge"
IN_VIEWPORT = "primdiffusion_volumes_in_viewport"
"""Custom property of a human's collection: whether viewports show the volumes; they do where it is missing, in humans
of earlier versions."""
VOLUMES_IN_VIEWPORT = False
"""For new humans."""


def attachment_of(collection: bpy.types.Collection) -> str:
    """The human's mode."""
    return stored_choice(collection, ATTACHMENT, MODES)


def set_attachment(collection: bpy.types.Collection, mode: str) -> None:
    """Show the human in another mode; its files stay, so undo and redo can switch.

    ARMATURE: each volume is an object whose frame is blended by linear blend skinning. SURFACE: instances of these
    volumes on the posed surface's tangent planes, where the paper and the engine place them. MERGED: one volume, made
    by `merged.show_merged` in one pose. SPLATS: see `splats`.
    Raises ValueError or FileNotFoundError before anything changes. Makes no undo step.
    """
    if mode not in MODES:
        raise ValueError(f"there is no attachment {mode!r}: choose from {', '.join(MODES)}")
    parts = _parts(collection)
    if mode == "MERGED" and parts["MERGED"] is None:
        raise ValueError(f"{collection.name!r} has no merged volume yet: press Merge")
    if mode == "SPLATS" and parts["SPLATS"] is None:
        raise ValueError(f"{collection.name!r} has no splats: import or generate the human in Blender 5.3 or newer")
    if mode == "SURFACE":
        parts["SURFACE"] = build_surface(collection)
    if mode == "MERGED" and attachment_of(collection) != "MERGED":
        collection[_BEFORE] = attachment_of(collection)
    collection[ATTACHMENT] = mode
    _show(collection, parts)


def _parts(collection: bpy.types.Collection) -> dict[str, bpy.types.Collection | bpy.types.Object | None]:
    """What each mode shows. Raises ValueError for humans that cannot be edited or whose volumes have no collection."""
    check_editable(collection)
    return {
        "ARMATURE": primitives_of(collection),
        "SURFACE": carrier_of(collection),
        "MERGED": merged_of(collection),
        "SPLATS": splats_in(collection),
    }


def _show(collection: bpy.types.Collection, parts: dict[str, bpy.types.Collection | bpy.types.Object | None]) -> None:
    for mode, part in parts.items():
        if part is not None:
            part.hide_render = mode != attachment_of(collection)
            part.hide_viewport = part.hide_render or not (mode == "SPLATS" or in_viewport(collection))


def in_viewport(collection: bpy.types.Collection) -> bool:
    """Whether viewports show the human's volumes; renders do in any case."""
    return stored_flag(collection, IN_VIEWPORT, True)


def volumes_may_wait(collection: bpy.types.Collection | None = None) -> bool:
    """Whether new volumes of a human, or of a new one, may be written after the scene shows it: splats show it, or
    viewports hide them, and there is a window, whose timer writes them."""
    if SPLATS_AVAILABLE if collection is None else attachment_of(collection) == "SPLATS":
        return True
    hidden = not (VOLUMES_IN_VIEWPORT if collection is None else in_viewport(collection))
    return hidden and not bpy.app.background


def show_in_viewport(collection: bpy.types.Collection, shown: bool) -> None:
    """Show the human's volumes in viewports, or hide them there: a thousand take a gigabyte once drawn.

    Makes no undo step. Raises ValueError for a human that cannot be edited, or whose volumes have no collection.
    """
    parts = _parts(collection)
    collection[IN_VIEWPORT] = shown
    _show(collection, parts)


def attachment_before_merge(collection: bpy.types.Collection) -> str:
    """The mode to return to when the merged volume is removed."""
    return stored_choice(collection, _BEFORE, [mode for mode in MODES if mode != "MERGED"])
