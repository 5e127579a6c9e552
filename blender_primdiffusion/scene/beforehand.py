"""What of building a person needs none of Blender's data: done in a thread, so that the window goes on."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import bpy
import numpy as np

from . import shape_file, volumes
from .human_file import HumanFile, read_human
from .overlap import most_overlapping


class Stopped(Exception):
    """Nobody waits for this person any more."""


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


def write(human_npz: Path, place: Place, step: Callable[[float], None]) -> Written:
    """Bake, and write the volumes, and the body's file beside their folder; `step` hears what fraction is done.

    Of somebody in the scene, volumes whose file is there are not written again.

    Raises HumanFileError, VolumeWriteError and what `step` raises, and then leaves no files.
    """
    began = time.monotonic()
    step(0.0)
    baked, home = bake(human_npz), place.home
    which = range(len(baked.grids.density)) if place.which is None else place.which
    files = {k: home / volumes.file_name(baked.grids, k, bpy.app.version) for k in which}
    absent = [k for k, path in files.items() if place.which is None or not path.is_file()]
    existing = next(parent for parent in (home, *home.parents) if parent.exists())
    model = baked.human.shape_model
    body = () if model is None else (home.parent / shape_file.file_name(model),)
    with contextlib.ExitStack() as undone:
        new = undone.enter_context(volumes.written(baked.grids, home, which=absent, step=step))
        made = tuple(path for path in (*new, *body) if not path.exists())
        if model is not None:
            undone.enter_context(shape_file.kept(model, home.parent))
    unread = tuple(path for path in files.values() if path not in place.shown)
    return Written(baked, home, unread, made, existing, began)


class Writing:
    """`write` in a thread."""

    def __init__(self, human_npz: Path, place: Place) -> None:
        bpy.utils.expose_bundled_modules()  # not for threads
        self.fraction = 0.0
        self.result: Written | None = None
        """None until it is done, and where it has failed."""
        self.error: Exception | None = None
        self._wanted, self._lock = True, threading.Lock()
        self._thread = threading.Thread(target=self._run, args=(human_npz, place), name="volumes")
        self._thread.start()

    @property
    def over(self) -> bool:
        """Done or failed."""
        return not self._thread.is_alive()

    def take(self) -> Written | None:
        """What was written, whose files are the caller's from now on; None where that has failed, or somebody has
        removed some. Waits for the end."""
        self._thread.join()
        written, self.result = self.result, None
        if written is not None and not written.whole():
            written.discard()
            return None
        return written

    def stop(self) -> None:
        """Have it end soon and leave no files; does not wait."""
        with self._lock:
            self._wanted = False
            if self.result is not None:
                self.result.discard()
                self.result = None

    def _run(self, human_npz: Path, place: Place) -> None:
        try:
            result = write(human_npz, place, self._step)
        except Exception as error:  # whoever asked decides: the thread has nobody to tell
            self.error = error
            return
        with self._lock:
            if self._wanted:
                self.result = result
            else:
                result.discard()

    def _step(self, fraction: float) -> None:
        if not self._wanted:
            raise Stopped
        self.fraction = fraction


def provenance(human: HumanFile, grids: volumes.Grids) -> str:
    """What `human.MARK` holds: where the person comes from, their betas, and how many boxes meet at most."""
    offset, half = grids.drawn_box()
    centre = human.position + np.einsum("kij,kj->ki", human.rotation, offset)
    most = most_overlapping(centre, human.rotation, half)
    return json.dumps({**human.meta, "betas": np.round(human.betas, 6).tolist(), "most_overlapping": most})
