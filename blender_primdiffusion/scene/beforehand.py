"""Write a person's volumes in slices of time before the person enters the scene, so that the window stays usable."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import bpy
import numpy as np

from . import volumes
from .human_npz import HumanFile, read_human
from .overlap import most_overlapping
from .shape import body_file_name, saved_body_file


@dataclasses.dataclass(frozen=True, eq=False)
class Baked:
    """A human.npz as the scene takes it."""

    human: HumanFile
    grids: volumes.Grids
    provenance: str
    """JSON, what `human.MARK` holds."""


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a person's volumes go, and which."""

    home: Path
    """The person's folder."""
    which: tuple[int, ...] | None = None
    """Primitives of somebody in the scene that volumes stand for; None for a new person, who gets them all."""
    shown: frozenset[Path] = frozenset()
    """Files that Blender has read: volumes show them."""


@dataclasses.dataclass(frozen=True, eq=False)
class Written:
    """A person whose volumes are in their folder before they are in the scene."""

    baked: Baked
    home: Path
    """The person's folder."""
    files: tuple[Path, ...]
    """Those that no volume shows yet: of a new person, one for each primitive."""
    made: tuple[Path, ...]
    """Of these, and the body's, those that were not there before."""
    existing: Path
    """The folder that was there before."""
    began: float
    """time.monotonic() when this was begun."""

    def whole(self) -> bool:
        """Nobody has removed a file since."""
        return all(path.is_file() for path in self.files)

    @contextlib.contextmanager
    def entering(self, home: Callable[[], Path]) -> Iterator[None]:
        """A block that puts the person into the scene. The files go where it fails, and where the person's folder,
        `home` after the block, is another meanwhile: the block has written them there once more."""
        try:
            yield
        except BaseException:
            self.discard()
            raise
        if (now := home()) != self.home:
            self.discard(but=now.parent)  # where the body's file is

    def discard(self, but: Path | None = None) -> None:
        """Nobody shows them: remove the files that were written, but not those in the folder `but`.

        One that the system does not let go of stays, and is one of the unused files.
        """
        for path in self.made:
            if path.parent != but:
                with contextlib.suppress(OSError):  # Windows keeps what somebody reads
                    path.unlink()
        with contextlib.suppress(OSError):
            volumes.remove_empty(self.home, self.existing)


def bake(human_npz: str | Path) -> Baked:
    """Read and bake. Raises HumanFileError."""
    human = read_human(human_npz)
    grids = volumes.bake(human.density, human.rgb, human.half_extent)
    return Baked(human, grids, provenance(human, grids))


def writing(human_npz: Path, place: Place) -> Generator[float, None, Written]:
    """Bake, and write the volumes, and the body's file beside their folder, in steps of some milliseconds (baking takes
    longer); yields what fraction is done.

    Of somebody in the scene, volumes whose file is there are not written again.

    Raises HumanFileError and VolumeWriteError; then, and when it is closed early, no files are left.
    """
    began = time.monotonic()
    yield 0.0
    human = read_human(human_npz)
    yield 0.0
    grids = volumes.bake(human.density, human.rgb, human.half_extent)
    yield 0.0
    baked, home = Baked(human, grids, provenance(human, grids)), place.home
    yield 0.0
    which = range(len(grids.density)) if place.which is None else place.which
    files = {k: home / volumes.file_name(grids, k, bpy.app.version) for k in which}
    absent = [k for k, path in files.items() if place.which is None or not path.is_file()]
    existing = next(parent for parent in (home, *home.parents) if parent.exists())
    model = human.shape_model
    body = () if model is None else (home.parent / body_file_name(model),)
    with contextlib.ExitStack() as undone:
        staging = undone.enter_context(volumes.staged(home))
        yield from staging.write(grids, absent)
        made = tuple(path for path in (*staging.paths, *body) if not path.exists())
        if model is not None:
            undone.enter_context(saved_body_file(model, home.parent))
    unread = tuple(path for path in files.values() if path not in place.shown)
    return Written(baked, home, unread, made, existing, began)


class Writing:
    """`writing`, a slice of time at a time."""

    def __init__(self, human_npz: Path, place: Place) -> None:
        self.fraction = 0.0
        self.result: Written | None = None
        """None until it is done, and where it has failed."""
        self.error: Exception | None = None
        self.over = False
        """Done, failed or stopped."""
        self._steps = writing(human_npz, place)

    def work(self, seconds: float) -> None:
        """Write for about `seconds`, one step at least."""
        end = time.monotonic() + seconds
        while not self.over:
            try:
                self.fraction = next(self._steps)
            except StopIteration as done:
                self.result, self.over = done.value, True
            except Exception as error:  # the operator tries again and reports why it fails
                self.error, self.over = error, True
            if time.monotonic() >= end:
                return

    def take(self) -> Written | None:
        """What was written, whose files are the caller's from now on; None where that has failed, or some files were
        removed. Writes what is left to write."""
        self.work(float("inf"))
        written, self.result = self.result, None
        if written is not None and not written.whole():
            written.discard()
            return None
        return written

    def stop(self) -> None:
        """End it and leave no files."""
        self._steps.close()
        self.over = True
        if self.result is not None:
            self.result.discard()
            self.result = None


def provenance(human: HumanFile, grids: volumes.Grids) -> str:
    """What `human.MARK` holds: where the person comes from, their betas, and how many boxes meet at most."""
    offset, half = grids.drawn_box()
    centre = human.position + np.einsum("kij,kj->ki", human.rotation, offset)
    most = most_overlapping(centre, human.rotation, half)
    return json.dumps({**human.meta, "betas": np.round(human.betas, 6).tolist(), "most_overlapping": most})
