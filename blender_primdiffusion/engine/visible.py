"""What one picture is made of: the dependency graph's instances, less what its viewport keeps out of sight."""

from __future__ import annotations

from collections.abc import Iterator

import bpy


def visible_instances(
    depsgraph: bpy.types.Depsgraph, space: bpy.types.SpaceView3D | None = None
) -> Iterator[bpy.types.DepsgraphObjectInstance]:
    """Everything the dependency graph shows; in a viewport's local view only what is in it, with its instances.

    An instance is valid until the next one is asked for.
    """
    local = space is not None and space.local_view is not None
    for instance in depsgraph.object_instances:
        if not instance.show_self:
            continue
        if local and not (instance.parent or instance.object).original.local_view_get(space):
            continue
        yield instance
