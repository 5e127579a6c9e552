"""Works that a restart of Blender, or another file, would lose: kept on disk, and offered until somebody decides."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import bpy

from ...places import own_folder
from .work import Work, registered_kind

if TYPE_CHECKING:
    from ...worker.kept_works import KeptWork, Shelf


class Kept:
    """What is in line, as on disk, and what was left: by a Blender that ended, or for a file that was closed."""

    def __init__(self) -> None:
        self.left: list[KeptWork] = []
        """Offered; nothing of it runs by itself."""
        self.trouble = ""
        """Why the line would not survive a restart; empty when it would."""
        self._in_line: list[KeptWork] = []
        self._set_aside: list[KeptWork] = []
        self._shelf: Shelf | None = None

    def save(self, in_line: Iterable[KeptWork]) -> None:
        """Keep these, and what was set aside."""
        self._in_line = list(in_line)
        try:
            self._shelf_of_now().keep([*self._set_aside, *self._in_line])
            self.trouble = ""
        except OSError as error:
            self.trouble = f"the works in line would not survive a restart of Blender: {error}"

    def set_aside(self) -> None:
        """What is in line is not wanted now: offer it."""
        self._set_aside += self._in_line
        self.save([])
        self.look()

    def look(self) -> None:
        """Find out what is left."""
        self.left = [*self._shelf_of_now().left(), *self._set_aside]

    def take(self, wanted: Callable[[KeptWork], bool]) -> list[KeptWork]:
        """What is offered and wanted, which then is offered no more, to nobody; the rest stays, as this Blender's."""
        offered = [*self._shelf_of_now().claim(), *self._set_aside]
        self._set_aside = self.left = [work for work in offered if not wanted(work)]
        self.save(self._in_line)
        return [work for work in offered if wanted(work)]

    def close(self) -> None:
        """The extension is going: what is kept stays on disk."""
        if self._shelf is not None:
            self._shelf.close()
        self._shelf, self.left, self._in_line, self._set_aside = None, [], [], []

    def _shelf_of_now(self) -> Shelf:
        if self._shelf is None:
            from ...worker.kept_works import Shelf

            self._shelf = Shelf(own_folder() / "queue")
        return self._shelf


def kept_work(work: Work, scene: str, blend: str) -> KeptWork | None:
    """`work` as it is kept; None for one that is not."""
    from ...worker.kept_works import KeptWork

    return None if work.not_kept_because else KeptWork(work.kind, work.label, work.to_json(), scene, blend)


def work_of(kept: KeptWork) -> Work:
    """The work again. Raises ValueError for one that this version does not understand."""
    kind = registered_kind(kept.kind)
    if kind is None:
        raise ValueError(f"this version knows no work {kept.kind!r} ({kept.label})")
    try:
        return kind.from_json(kept.work)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{kept.label!r} was kept by another version and cannot be read: {error}") from error


def is_open(blend: str) -> bool:
    """This is the path of the file that is open now. A work's file that was never saved is gone."""
    return bool(blend) and _real(blend) == _real(bpy.data.filepath)


def home_of(kept: KeptWork) -> bpy.types.Scene | None:
    """The scene that it was asked for, where that is in the file that is open now."""
    return bpy.data.scenes.get(kept.scene) if is_open(kept.blend) else None


def meant_for(kept: KeptWork) -> str:
    """For people: where the work was asked for."""
    file = bpy.path.basename(kept.blend) or "a file never saved"
    gone = " (not there any more)" if is_open(kept.blend) and home_of(kept) is None else ""
    return f"{file}, {kept.scene}{gone}"


def _real(path: str) -> str:
    return os.path.normcase(os.path.realpath(path))
