"""What a capture has brought into the file, so that all of it, and nothing else, can be taken out again."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

_NEVER_OURS = frozenset({"window_managers", "workspaces", "screens", "libraries"})


class Belongings:
    """Notes the data-blocks that come into being within `with` blocks; `remove` takes them out.

    What others make between the blocks stays.
    """

    def __init__(self) -> None:
        self._ours: set[int] = set()
        self._before: set[int] = set()

    def __enter__(self) -> Belongings:
        self._before = {block.session_uid for block in data_blocks()}
        return self

    def __exit__(self, *_: object) -> None:
        self._ours |= {block.session_uid for block in data_blocks()} - self._before

    def remove(self) -> None:
        """Take out what is left of them."""
        bpy.data.batch_remove([block for block in data_blocks() if block.session_uid in self._ours])
        self._ours.clear()


def data_blocks() -> Iterator[bpy.types.ID]:
    """Everything in the file but windows."""
    for prop in bpy.data.bl_rna.properties:
        if prop.type == "COLLECTION" and prop.identifier not in _NEVER_OURS:
            yield from getattr(bpy.data, prop.identifier)
