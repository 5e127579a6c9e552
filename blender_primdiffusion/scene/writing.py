"""Write a human's volumes in slices of time, before the human enters the scene, so that the window stays usable.

`write_volumes` is the one way from a human.npz to files: `VolumeWriter` runs it a slice at a time, `write_now` at once.
What it returns enters the scene by `build.build_written`, `edit.replace_person` or `edit.restore_volumes`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from pathlib import Path

import bpy
import numpy as np

from .human_npz import HumanFile, read_human
from .overlap import max_overlap
from .shape import body_file_name, saved_body_file
from .volumes import Grids, bake, file_name, remove_empty, staged


@dataclasses.dataclass(frozen=True)
class Destination:
    """Where a human's volumes go, and which ones."""

    folder: Path
    """The human's folder."""
    which: tuple[int, ...] | None = None
    """Primitives of a human in the scene that have volumes; None for a new human, where all are written."""
    shown: frozenset[Path] = frozenset()
    """Files that Blender has read already, since volumes show them."""


@dataclasses.dataclass(frozen=True, eq=False)
class WrittenHuman:
    """A human whose volumes are in their folder but not yet in the scene."""

    human: HumanFile
    grids: Grids
    provenance: str
    """JSON, for the custom property `human.MARK`."""
    folder: Path
    files: tuple[Path, ...]
    """Volumes that Blender has not read; for a new human, one for each primitive."""
    made: tuple[Path, ...]
    """Files, of volumes and the body, that did not exist before."""
    existing: Path
    """The innermost folder that existed before."""
    names: Mapping[int, str]
    """File names of the volumes that were asked for, by primitive."""
    began: float
    """time.monotonic() when writing began."""

    def complete(self) -> bool:
        """Whether all files still exist."""
        return all(path.is_file() for path in self.files)

    @contextlib.contextmanager
    def entering(self, folder: Callable[[], Path]) -> Iterator[None]:
        """A block that puts the human into the scene. Removes the written files when the block fails, and when the
        human's folder, `folder()` after the block, has become another one, where `files_in` has written them again."""
        try:
            yield
        except BaseException:
            self.discard()
            raise
        if (now := folder()) != self.folder:
            self.discard(but=now.parent)  # where the body's file is

    @contextlib.contextmanager
    def files_in(self, folder: Path, which: Iterable[int], keep: Mapping[str, Path]) -> Iterator[dict[int, Path]]:
        """Paths in `folder` of the volumes `which`, by primitive.

        When the block ends well, volumes that are not there (they were written elsewhere, or removed since) are
        written again, and the files in `keep` copied there under the names given. Raises VolumeWriteError.
        """
        files = {k: folder / (self.names.get(k) or file_name(self.grids, k, bpy.app.version)) for k in which}
        with staged(folder) as staging:
            for _ in staging.write(self.grids, [k for k, path in files.items() if not path.is_file()]):
                pass
            staging.copy(keep)
            yield files

    def discard(self, but: Path | None = None) -> None:
        """Remove the files that were written, except those in the folder `but`.

        A file that the system has locked stays, and counts as unused.
        """
        for path in self.made:
            if path.parent != but:
                with contextlib.suppress(OSError):  # Windows locks files that are being read
                    path.unlink()
        with contextlib.suppress(OSError):
            remove_empty(self.folder, self.existing)


def write_volumes(human_npz: Path, destination: Destination) -> Generator[float, None, WrittenHuman]:
    """Bake and write the volumes, and the body's file beside their folder, in steps of some milliseconds (baking takes
    longer); yields the fraction done.

    For a human in the scene, volumes whose file exists are not written again. Raises HumanFileError and
    VolumeWriteError; then, and when it is closed early, no files are left.
    """
    began, folder = time.monotonic(), destination.folder
    yield 0.0
    human = read_human(human_npz)
    yield 0.0
    grids = bake(human.density, human.rgb, human.half_extent)
    yield 0.0
    provenance = _provenance(human, grids)
    yield 0.0
    count = len(grids.density)
    which = range(count) if destination.which is None else [k for k in destination.which if k < count]
    names = {k: file_name(grids, k, bpy.app.version) for k in which}
    files = {k: folder / name for k, name in names.items()}
    absent = [k for k, path in files.items() if destination.which is None or not path.is_file()]
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    model = human.shape_model
    body = () if model is None else (folder.parent / body_file_name(model),)
    with contextlib.ExitStack() as undone:
        staging = undone.enter_context(staged(folder))
        yield from staging.write(grids, absent)
        made = tuple(path for path in (*staging.paths, *body) if not path.exists())
        if model is not None:
            undone.enter_context(saved_body_file(model, folder.parent))
    unread = tuple(path for path in files.values() if path not in destination.shown)
    return WrittenHuman(human, grids, provenance, folder, unread, made, existing, names, began)


def write_now(human_npz: str | Path, destination: Destination) -> WrittenHuman:
    """Run `write_volumes` to its end; raises as it does."""
    steps = write_volumes(Path(human_npz), destination)
    while True:
        try:
            next(steps)
        except StopIteration as done:
            return done.value


class VolumeWriter:
    """`write_volumes`, a slice of time at a time."""

    def __init__(self, human_npz: Path, destination: Destination) -> None:
        self.fraction = 0.0
        self.result: WrittenHuman | None = None
        """None until it is done, and where it has failed."""
        self.error: Exception | None = None
        self.over = False
        """Done, failed or stopped."""
        self._steps = write_volumes(human_npz, destination)

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

    def take(self) -> WrittenHuman | None:
        """The result, whose files are the caller's from now on; None where writing failed or files were removed.

        Finishes writing first.
        """
        self.work(float("inf"))
        written, self.result = self.result, None
        if written is not None and not written.complete():
            written.discard()
            return None
        return written

    def stop(self) -> None:
        """Stop, and leave no files."""
        self._steps.close()
        self.over = True
        if self.result is not None:
            self.result.discard()
            self.result = None


def _provenance(human: HumanFile, grids: Grids) -> str:
    offset, half = grids.drawn_box()
    centre = human.position + np.einsum("kij,kj->ki", human.rotation, offset)
    most = max_overlap(centre, human.rotation, half)
    return json.dumps({**human.meta, "betas": np.round(human.betas, 6).tolist(), "most_overlapping": most})
