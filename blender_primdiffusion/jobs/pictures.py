"""Pictures that panels draw: of the human being generated, and of variations."""

from __future__ import annotations

from pathlib import Path

import bpy.utils.previews


class Icons:
    """Previews of files, each read when it is first drawn and when it was written again."""

    def __init__(self) -> None:
        self._previews: bpy.utils.previews.ImagePreviewCollection | None = None
        self._versions: dict[str, int] = {}

    def of(self, path: Path | None) -> int:
        """The icon of a file for `template_icon`; 0, which is empty, where there is none."""
        try:
            version = path.stat().st_mtime_ns if path is not None else 0
        except OSError:
            version = 0
        if not version:
            return 0
        if self._previews is None:  # an empty collection is false
            self._previews = bpy.utils.previews.new()
        name = str(path)
        if name not in self._previews or self._versions[name] != version:
            for old in [old for old in self._previews if old == name or not Path(old).exists()]:
                del self._previews[old]
            _ = self._previews.load(name, name, "IMAGE").image_size[:]  # reads the file now: later it may be gone
            self._versions[name] = version
        return self._previews[name].icon_id

    def free(self) -> None:
        """Free all previews."""
        if self._previews is not None:
            bpy.utils.previews.remove(self._previews)
        self._previews, self._versions = None, {}


icons = Icons()
