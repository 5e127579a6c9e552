"""What renders show of a human: its splats, its volumes, or the merged volume."""

from __future__ import annotations

import bpy

from .blend_values import stored_choice, stored_flag
from .human import check_editable
from .merged import merged_of
from .splats import SPLATS_AVAILABLE, build_splats, cloud_of
from .volume_nodes import IN_VIEWPORT, build_volumes, volumes_of

REPRESENTATION = "primdiffusion_representation"
"""Custom property of a human: one of REPRESENTATIONS."""
REPRESENTATIONS = ("VOLUMES", "MERGED", "SPLATS")


def representation_of(person: bpy.types.Object) -> str:
    """One of REPRESENTATIONS."""
    return stored_choice(person, REPRESENTATION, REPRESENTATIONS)


def set_representation(person: bpy.types.Object, wanted: str) -> None:
    """Show the human in another way; its other parts stay, so undo and redo can switch.

    VOLUMES: a volume for each primitive, in the frames in which the paper and the engine place them. MERGED: one
    volume, made by `merged.show_merged` in one pose. SPLATS: see `splats`.
    Raises ValueError or FileNotFoundError before anything changes. Makes no undo step.
    """
    if wanted not in REPRESENTATIONS:
        raise ValueError(f"a human cannot be shown as {wanted!r}: choose from {', '.join(REPRESENTATIONS)}")
    parts = parts_by_representation(person)
    if wanted == "MERGED" and parts["MERGED"] is None:
        raise ValueError(f"{person.name!r} has no merged volume yet: press Merge")
    if wanted == "SPLATS" and not SPLATS_AVAILABLE:
        raise ValueError("splats need Blender 5.3 or newer")
    if parts[wanted] is None:
        parts[wanted] = build_splats(person) if wanted == "SPLATS" else build_volumes(person)
    person[REPRESENTATION] = wanted
    _show(person, parts)


def parts_by_representation(person: bpy.types.Object) -> dict[str, bpy.types.Object | None]:
    """What each shows. Raises ValueError for humans that cannot be edited."""
    check_editable(person)
    return {"VOLUMES": volumes_of(person), "MERGED": merged_of(person), "SPLATS": cloud_of(person)}


def _show(person: bpy.types.Object, parts: dict[str, bpy.types.Object | None]) -> None:
    for name, part in parts.items():
        if part is not None:
            part.hide_render = name != representation_of(person)
            part.hide_viewport = part.hide_render or not (name == "SPLATS" or in_viewport(person))


def in_viewport(person: bpy.types.Object) -> bool:
    """Whether viewports show the human's volumes; renders do in any case."""
    return stored_flag(person, IN_VIEWPORT, False)


def show_in_viewport(person: bpy.types.Object, shown: bool) -> None:
    """Show the human's volumes in viewports, or hide them there: a thousand take a gigabyte once drawn.

    Makes no undo step. Raises ValueError for a human that cannot be edited.
    """
    parts = parts_by_representation(person)
    person[IN_VIEWPORT] = shown
    _show(person, parts)


def without_merged(person: bpy.types.Object) -> str:
    """What shows a human whose merged volume is removed: its splats if it has any, else its volumes."""
    return "SPLATS" if SPLATS_AVAILABLE and cloud_of(person) is not None else "VOLUMES"
