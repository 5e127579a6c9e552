"""What shows a human: volumes that follow the armature, or lie on the posed surface, or are merged; or its splats."""

from __future__ import annotations

import bpy

from .blend_values import stored_choice, stored_flag
from .human import check_editable
from .merged import merged_of
from .splats import SPLATS_AVAILABLE, build_splats, cloud_of
from .surface import build_surface, carrier_of, primitives_of
from .volume_objects import build_volumes

ATTACHMENT = "primdiffusion_attachment"
"""Custom property of a human: one of MODES; ARMATURE where it is missing."""
MODES = ("ARMATURE", "SURFACE", "MERGED", "SPLATS")
_BEFORE = "primdiffusion_attachment_before_merge"
IN_VIEWPORT = "primdiffusion_volumes_in_viewport"
"""Custom property of a human: whether viewports show the volumes; they do where it is missing, in humans
of earlier versions."""
VOLUMES_IN_VIEWPORT = False
"""For new humans."""


def attachment_of(person: bpy.types.Object) -> str:
    """The human's mode."""
    return stored_choice(person, ATTACHMENT, MODES)


def set_attachment(person: bpy.types.Object, mode: str) -> None:
    """Show the human in another mode; its files stay, so undo and redo can switch.

    ARMATURE: each volume is an object whose frame is blended by linear blend skinning. SURFACE: instances of these
    volumes on the posed surface's tangent planes, where the paper and the engine place them. MERGED: one volume, made
    by `merged.show_merged` in one pose. SPLATS: see `splats`.
    Raises ValueError or FileNotFoundError before anything changes. Makes no undo step.
    """
    if mode not in MODES:
        raise ValueError(f"there is no attachment {mode!r}: choose from {', '.join(MODES)}")
    parts = parts_by_mode(person)
    if mode == "MERGED" and parts["MERGED"] is None:
        raise ValueError(f"{person.name!r} has no merged volume yet: press Merge")
    if mode == "SPLATS" and not SPLATS_AVAILABLE:
        raise ValueError("splats need Blender 5.3 or newer")
    if mode == "SPLATS" and parts["SPLATS"] is None:
        parts["SPLATS"] = build_splats(person)
    if mode in ("ARMATURE", "SURFACE") and parts["ARMATURE"] is None:
        parts["ARMATURE"] = build_volumes(person)
    if mode == "SURFACE":
        parts["SURFACE"] = build_surface(person)
    if mode == "MERGED" and attachment_of(person) != "MERGED":
        person[_BEFORE] = attachment_of(person)
    person[ATTACHMENT] = mode
    _show(person, parts)


def parts_by_mode(person: bpy.types.Object) -> dict[str, bpy.types.Collection | bpy.types.Object | None]:
    """What each mode shows. Raises ValueError for humans that cannot be edited or whose volumes have no collection."""
    check_editable(person)
    return {
        "ARMATURE": primitives_of(person),
        "SURFACE": carrier_of(person),
        "MERGED": merged_of(person),
        "SPLATS": cloud_of(person),
    }


def _show(person: bpy.types.Object, parts: dict[str, bpy.types.Collection | bpy.types.Object | None]) -> None:
    for mode, part in parts.items():
        if part is not None:
            part.hide_render = mode != attachment_of(person)
            part.hide_viewport = part.hide_render or not (mode == "SPLATS" or in_viewport(person))


def in_viewport(person: bpy.types.Object) -> bool:
    """Whether viewports show the human's volumes; renders do in any case."""
    return stored_flag(person, IN_VIEWPORT, True)


def volumes_may_wait(person: bpy.types.Object) -> bool:
    """Whether a human's volumes may be written after the scene shows it: splats show it, or viewports hide them, and
    there is a window, whose timer writes them."""
    return attachment_of(person) == "SPLATS" or (not in_viewport(person) and not bpy.app.background)


def show_in_viewport(person: bpy.types.Object, shown: bool) -> None:
    """Show the human's volumes in viewports, or hide them there: a thousand take a gigabyte once drawn.

    Makes no undo step. Raises ValueError for a human that cannot be edited, or whose volumes have no collection.
    """
    parts = parts_by_mode(person)
    person[IN_VIEWPORT] = shown
    _show(person, parts)


def attachment_before_merge(person: bpy.types.Object) -> str:
    """The mode to return to when the merged volume is removed."""
    return stored_choice(person, _BEFORE, [mode for mode in MODES if mode != "MERGED"])
