"""What the child can be asked for, and what becomes of the answer: rooms subclass `Job` for what they offer."""

from __future__ import annotations

import abc
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import bpy

from ..places import preference

if TYPE_CHECKING:
    from ..scene.writing import Destination


class Job(abc.ABC):
    """One thing the child is asked for. Plain data alone: undo and loading replace Blender's objects meanwhile."""

    kind: ClassVar[str]
    """Under which panels show it and a kept one is found again; unique."""
    method: ClassVar[str]
    """Of the child."""
    undo: ClassVar[str] = ""
    """Name of the undo step that `finish` makes; empty when it leaves the scene as it is."""
    new_person: str = ""
    """Name of the person whom `finish` builds of the answer's "human"; empty for works that build nobody."""

    @property
    @abc.abstractmethod
    def label(self) -> str:
        """For people: Human, seed 7."""

    @abc.abstractmethod
    def params(self, folder: Path) -> dict[str, Any]:
        """Of the child's method, asked for when the turn has come; `folder` is for its files, empty, and removed
        after `finish`. Raises ValueError or OSError where it cannot be done any more."""

    @abc.abstractmethod
    def finish(self, context: bpy.types.Context, result: dict[str, Any], folder: Path) -> str:
        """Put the child's answer into the scene of `context`; returns the news for the panel.

        Runs inside an operator, in object mode where `undo` is given; that operator makes the undo step. ValueError,
        OSError and RuntimeError become the panel's error, and must leave the scene as it was.
        """

    def advance(self, folder: Path) -> bool:
        """Do a little with the files that the child has written so far, in the time of a timer's tick; whether there is
        more to do at once. Called while the child is running, and then until there is no more, before `finish`."""
        return False

    def place(self) -> Destination | None:
        """Where the volumes of the answer's "human" go, which are written before `finish`; None for works that show
        nobody. Asked for when the answer is there. ValueError and OSError are left to `finish` to tell."""
        if not self.new_person:
            return None
        from ..scene.build import next_folder
        from ..scene.writing import Destination

        return Destination(next_folder(self.new_person))


def chosen_checkpoint(name: str) -> str:
    """The file of the preference `checkpoint` or `encoder`; empty: the one that comes with the extension."""
    return preference(name)
