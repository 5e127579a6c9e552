"""What renders show of a human, and 3D views: its splats, its volumes, the merged volume or the mesh proxy."""

from __future__ import annotations

import bpy

from .blend_values import stored_choice, stored_flag
from .human import check_editable, proxy_of
from .merged import merged_of
from .splats import SPLATS_AVAILABLE, build_splats, cloud_of
from .volume_nodes import IN_VIEWPORT, build_volumes, volumes_of

REPRESENTATION = "primdiffusion_representation"
"""Custom property of a human: one of REPRESENTATIONS."""
REPRESENTATIONS = ("VOLUMES", "MERGED", "SPLATS", "MESH")
MESH_IN_VIEWPORT = "MESH_IN_VIEWPORT"


def representation_of(person: bpy.types.Object) -> str:
    """What renders show, one of REPRESENTATIONS."""
    return stored_choice(person, REPRESENTATION, REPRESENTATIONS)


def set_representation(person: bpy.types.Object, wanted: str) -> None:
    """Show the human in another way; its other parts stay, so undo and redo can switch.

    VOLUMES: a volume for each primitive, in the frames in which the paper and the engine place them. MERGED: one
    volume, made by `merged.show_merged` in one pose. SPLATS: see `splats`. MESH: the mesh proxy. MESH_IN_VIEWPORT: the
    mesh proxy in viewports, while renders show what they showed.
    Raises ValueError or FileNotFoundError before anything changes. Makes no undo step.
    """
    if wanted not in (*REPRESENTATIONS, MESH_IN_VIEWPORT):
        raise ValueError(f"a human cannot be shown as {wanted!r}: choose from {', '.join(REPRESENTATIONS)}")
    parts, now = parts_by_representation(person), representation_of(person)
    with_mesh = wanted in ("MESH", MESH_IN_VIEWPORT)
    if wanted == MESH_IN_VIEWPORT:
        wanted = own_representation(person) if now == "MESH" else now
    if with_mesh and parts["MESH"] is None:
        raise ValueError(f"{person.name!r} has no mesh proxy yet: press Add Mesh Proxy")
    if wanted == "MERGED" and parts["MERGED"] is None:
        raise ValueError(f"{person.name!r} has no merged volume yet: press Merge Pose")
    if wanted == "SPLATS" and not SPLATS_AVAILABLE:
        raise ValueError("splats need Blender 5.3 or newer")
    if parts[wanted] is None:
        parts[wanted] = build_splats(person) if wanted == "SPLATS" else build_volumes(person)
    person[REPRESENTATION] = wanted
    _show(person, parts, mesh_in_viewport=with_mesh)


def parts_by_representation(person: bpy.types.Object) -> dict[str, bpy.types.Object | None]:
    """What each shows. Raises ValueError for humans that cannot be edited."""
    check_editable(person)
    return {
        "VOLUMES": volumes_of(person),
        "MERGED": merged_of(person),
        "SPLATS": cloud_of(person),
        "MESH": proxy_of(person),
    }


def _show(person: bpy.types.Object, parts: dict[str, bpy.types.Object | None], *, mesh_in_viewport: bool) -> None:
    now = representation_of(person)
    for name, part in parts.items():
        if part is None:
            continue
        part.hide_render = name != now
        if name == "MESH":
            part.hide_viewport = not mesh_in_viewport
        else:
            part.hide_viewport = mesh_in_viewport or part.hide_render or not (name == "SPLATS" or in_viewport(person))


def in_viewport(person: bpy.types.Object) -> bool:
    """Whether viewports show the human's volumes; renders do in any case."""
    return stored_flag(person, IN_VIEWPORT, False)


def show_in_viewport(person: bpy.types.Object, shown: bool) -> None:
    """Show the human's volumes in viewports, or hide them there: a thousand take a gigabyte once drawn.

    A mesh proxy in viewports stays in their place. Makes no undo step. Raises ValueError for a human that cannot be
    edited.
    """
    parts = parts_by_representation(person)
    person[IN_VIEWPORT] = shown
    _show(person, parts, mesh_in_viewport=mesh_in_viewport(person))


def mesh_in_viewport(person: bpy.types.Object) -> bool:
    """Whether viewports show the mesh proxy."""
    proxy = proxy_of(person)
    return proxy is not None and not proxy.hide_viewport


def stop_showing(person: bpy.types.Object, name: str) -> None:
    """Show what else there is before the merged volume or the mesh proxy is removed. Raises as `set_representation`."""
    now = representation_of(person)
    if name in (now, "MESH"):
        set_representation(person, own_representation(person) if now == name else now)


def own_representation(person: bpy.types.Object) -> str:
    """Splats if the human has any, else volumes: what needs no merging and no mesh."""
    return "SPLATS" if SPLATS_AVAILABLE and cloud_of(person) is not None else "VOLUMES"
