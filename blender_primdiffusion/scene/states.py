"""The next state of a human: a new folder with its files, made in slices of time before the scene shows it.

Blender caches grids by path, so a state that differs has other paths: `Human/0003/prim_0007.vdb`. Folders of earlier
states stay for undo until the user removes unused files; those of a .blend that was never saved go when Blender ends.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import time
from collections.abc import Generator, Iterator
from pathlib import Path

import bpy

from ..formats.regular_files import portable_name
from .attachment import volumes_may_wait
from .human import (
    BODY_FILE,
    PERSON_FILE,
    copy_file,
    home_of,
    humans_folder,
    is_own,
    new_state,
    remove_state,
    volume_name,
    volumes_of,
    write_error,
)
from .rest_human import RestHuman, read_human
from .volumes import write_volume

NAME_LENGTH = 40
"""Characters of a new human's name; names of its parts are longer, and Blender allows 63."""


@dataclasses.dataclass(frozen=True, eq=False)
class PreparedHuman:
    """A human whose files are in the folder of a new state, but which the scene does not show yet."""

    human: RestHuman
    provenance: str
    """JSON, for the custom property `human.MARK`."""
    folder: Path
    began: float
    """time.monotonic() when preparing began."""

    @contextlib.contextmanager
    def entering(self) -> Iterator[None]:
        """A block that puts the human into the scene. Removes its files when the block fails."""
        try:
            yield
        except BaseException:
            remove_state(self.folder)
            raise


def next_folder(name: str) -> Path:
    """`folder_of` the next human that is built under this name: Blender numbers names."""
    name = name[:NAME_LENGTH]
    taken = {collection.name for collection in bpy.data.collections if collection.library is None}
    numbered = (f"{name}.{number:03d}" for number in itertools.count(1))
    free = name if name not in taken else next(candidate for candidate in numbered if candidate not in taken)
    return humans_folder() / portable_name(bpy.path.clean_name(free))


def prepare(
    person: Path, name: str = "Human", replaced: bpy.types.Collection | None = None
) -> Generator[float, None, PreparedHuman]:
    """Make the folder of a new human of this name, or of the next state of the human `replaced`, from a human's file.

    The volumes that cannot wait (see `volumes_may_wait`) are written too: those that `replaced` has, or all. Steps take
    some milliseconds (baking takes longer) and yield the fraction done. Raises as `read_human`, also for what cannot be
    written; then, and when it is closed early, no files are left.
    """
    began, waiting = time.monotonic(), volumes_may_wait(replaced)
    home, shown = (next_folder(name), None) if replaced is None else (home_of(replaced), tuple(volumes_of(replaced)))
    yield 0.0
    human = read_human(person)
    yield 0.0
    grids = human.grids()
    yield 0.0
    provenance = human.provenance(grids)
    yield 0.0
    count = len(human.payload.density)
    which = () if waiting else range(count) if shown is None else [k for k in shown if k < count]
    folder = new_state(home)
    with contextlib.ExitStack() as undone:
        undone.callback(remove_state, folder)
        try:
            copy_file(person, folder / PERSON_FILE, folder)
            if human.payload.rest_half_extent is not None:
                copy_file(person.with_name(BODY_FILE), folder / BODY_FILE, folder)
            for number, k in enumerate(which):
                yield number / len(which)
                write_volume(grids, k, folder / volume_name(k))
        except (OSError, RuntimeError) as error:  # openvdb reports a full disk as RuntimeError
            raise write_error(home, error) from error
        undone.pop_all()
    return PreparedHuman(human, provenance, folder, began)


def prepare_now(person: Path, name: str = "Human", replaced: bpy.types.Collection | None = None) -> PreparedHuman:
    """Run `prepare` to its end; raises as it does."""
    steps = prepare(person, name, replaced)
    while True:
        try:
            next(steps)
        except StopIteration as done:
            return done.value


class Preparation:
    """`prepare`, a slice of time at a time."""

    def __init__(self, person: Path, name: str = "Human", replaced: bpy.types.Collection | None = None) -> None:
        self.fraction = 0.0
        self.result: PreparedHuman | None = None
        """None until it is done, and where it has failed."""
        self.over = False
        """Done, failed or stopped."""
        self._steps = prepare(person, name, replaced)
        next(self._steps)  # looks at the scene, which undo may replace afterwards

    def work(self, seconds: float) -> None:
        """Work for about `seconds`, one step at least."""
        end = time.monotonic() + seconds
        while not self.over:
            try:
                self.fraction = next(self._steps)
            except StopIteration as done:
                self.result, self.over = done.value, True
            except Exception:  # the operator tries again and reports why it fails
                self.over = True
            if time.monotonic() >= end:
                return

    def take(self) -> PreparedHuman | None:
        """The result, whose files are the caller's from now on; None where it failed, its files were removed, or the
        .blend has another folder by now.

        Finishes the work first.
        """
        self.work(float("inf"))
        prepared, self.result = self.result, None
        if prepared is None or ((prepared.folder / PERSON_FILE).is_file() and is_own(prepared.folder)):
            return prepared
        remove_state(prepared.folder)
        return None

    def stop(self) -> None:
        """Stop, and leave no files."""
        self._steps.close()
        self.over = True
        if self.result is not None:
            remove_state(self.result.folder)
            self.result = None
