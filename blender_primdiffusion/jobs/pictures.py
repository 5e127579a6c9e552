"""Pictures that panels draw: of the human being generated, and of files."""

from __future__ import annotations

from pathlib import Path

import bpy.utils.previews

_NAME = "so far"


class SoFar:
    """One picture at a time; the one before is freed."""

    def __init__(self) -> None:
        self._collection: bpy.utils.previews.ImagePreviewCollection | None = None
        self._shown: tuple[Path, int] | None = None

    def show(self, path: Path | None) -> bool:
        """Show this PNG, or nothing; whether the picture has changed.

        It is read now, since the child may replace the file. A file that cannot be read changes nothing.
        """
        if path is None:
            changed, self._shown = self._shown is not None, None
            if changed and self._collection is not None:
                self._collection.clear()
            return changed
        try:
            version = (path, path.stat().st_mtime_ns)
        except OSError:
            return False
        if version == self._shown:
            return False
        if self._collection is None:
            self._collection = bpy.utils.previews.new()
        self._collection.clear()
        preview = self._collection.load(_NAME, str(path), "IMAGE")
        self._shown = version if preview.image_size[0] else None  # asking for the size reads the file
        return True

    @property
    def icon(self) -> int:
        """For `UILayout.template_icon`; 0 for none, and without a window."""
        return self._collection[_NAME].icon_id if self._shown is not None else 0

    @property
    def shown(self) -> Path | None:
        """The file of the picture."""
        return self._shown[0] if self._shown is not None else None

    def close(self) -> None:
        """Free the picture."""
        if self._collection is not None:
            bpy.utils.previews.remove(self._collection)
        self._collection = self._shown = None


so_far = SoFar()
"""One job at a time: one picture."""


class Icons:
    """Previews that are freed together."""

    def __init__(self) -> None:
        self._previews: bpy.utils.previews.ImagePreviewCollection | None = None

    def of(self, path: Path | None) -> int:
        """The icon of a file for `template_icon`; 0, which is empty, where there is no file."""
        if path is None or not path.is_file():
            return 0
        if self._previews is None:
            self._previews = bpy.utils.previews.new()
        name = str(path)
        if name not in self._previews:
            preview = self._previews.load(name, name, "IMAGE")
            _ = preview.image_size[:]  # reads the file now: later it may be gone
        return self._previews[name].icon_id

    def free(self) -> None:
        """Free all previews."""
        if self._previews is not None:
            bpy.utils.previews.remove(self._previews)
            self._previews = None


icons = Icons()
