"""Pictures in panels: previews by path, made when they are drawn."""

from __future__ import annotations

from pathlib import Path

import bpy.utils.previews


class Icons:
    """Previews that are freed together."""

    def __init__(self) -> None:
        self._previews: bpy.utils.previews.ImagePreviewCollection | None = None

    def of(self, path: Path | None) -> int:
        """The number of the icon for `template_icon`; 0, which is empty, without such a file."""
        if path is None or not path.is_file():
            return 0
        if self._previews is None:
            self._previews = bpy.utils.previews.new()
        name = str(path)
        if name not in self._previews:
            preview = self._previews.load(name, name, "IMAGE")
            _ = preview.image_size[:]  # reads the file now: Blender would do so later, when it may be gone
        return self._previews[name].icon_id

    def free(self) -> None:
        """All of them."""
        if self._previews is not None:
            bpy.utils.previews.remove(self._previews)
            self._previews = None


icons = Icons()
