"""What is seen of a person who has a mesh proxy: the volumes, the mesh, or the mesh until it is rendered."""

from __future__ import annotations

import bpy

from ...scene.attachment import attachment_of, set_attachment


def show(person: bpy.types.Collection, what: str) -> None:
    """Switch to `what` of `settings.SHOWN`. Raises ValueError where there is no proxy; makes no undo step."""
    from ...scene.merged import merged_of
    from ...scene.proxy import proxy_of
    from ...scene.surface import carrier_of, primitives_of

    proxy = proxy_of(person)
    if proxy is None:
        raise ValueError(f"{person.name!r} has no mesh proxy yet: press Add Mesh Proxy")
    set_attachment(person, attachment_of(person))  # the volumes' parts as their mode wants them
    proxy.hide_viewport, proxy.hide_render = what == "VOLUMES", what != "MESH"
    for part in (primitives_of(person), carrier_of(person), merged_of(person)):
        if part is not None:
            part.hide_viewport = part.hide_viewport or what != "VOLUMES"
            part.hide_render = part.hide_render or what == "MESH"


def shown(person: bpy.types.Collection) -> str:
    """Which of `settings.SHOWN` holds now."""
    from ...scene.proxy import proxy_of

    proxy = proxy_of(person)
    if proxy is None or proxy.hide_viewport:
        return "VOLUMES"
    return "VIEWPORT" if proxy.hide_render else "MESH"
