"""Write and load volumes in slices of time before the operator runs, so that the operator returns quickly."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..scene.writing import Destination, VolumeWriter, WrittenHuman
    from .job import Job
    from .queue import Entry

SLICE_S = 0.05
"""Of writing volumes or reading grids between two times that the window is drawn."""
_SHOWN_STEPS = 10
"""Of the bar: to draw a window takes long, on some machines longer than SLICE_S."""
_WRITING = 0.6
"""How much of the time goes by until all is written."""


class Building:
    """One person at a time. All methods are for Blender's main thread."""

    def __init__(self) -> None:
        self._entry: Entry | None = None
        self._human: Path | None = None
        self._writing: VolumeWriter | None = None
        self._read = 0
        self._shown = 0

    @property
    def fraction(self) -> float:
        """How far the person is, 0 to 1; 1 when there is none."""
        if self._writing is None:
            return 1.0
        if not self._writing.over:
            return _WRITING * self._writing.fraction
        written = self._writing.result
        if written is None or not written.files:
            return 1.0
        return _WRITING + (1 - _WRITING) * self._read / len(written.files)

    @property
    def busy(self) -> bool:
        """Volumes are to be written or grids to be read."""
        if self._writing is None:
            return False
        written = self._writing.result
        return not self._writing.over or (written is not None and self._read < len(written.files))

    def moved(self) -> bool:
        """Whether the bar has come a step further since this was asked last."""
        before, self._shown = self._shown, int(_SHOWN_STEPS * self.fraction)
        return self._shown != before

    def begin(self, entry: Entry, result: dict[str, Any]) -> None:
        """Start, once, on the person that `entry` shows of the child's `result`, if it shows any."""
        if entry is self._entry:
            return
        self.close()
        self._entry = entry
        place = _place(entry.job) if "human" in result else None
        if place is not None:
            from ..scene.writing import VolumeWriter

            self._human = Path(result["human"])
            self._writing = VolumeWriter(self._human, place)

    def goes_on(self, *, may_work: bool) -> bool:
        """Whether there is more to do before the operator runs; does some of it where that is allowed now."""
        if self._writing is None:
            return False
        if not self._writing.over:
            if may_work:
                self._writing.work(SLICE_S)
            return self.busy
        written = self._writing.result
        if written is None or self._read == len(written.files):
            return False  # where it failed, the operator tries again and reports why
        if may_work:
            from ..scene.grid_cache import free_unused_grids, read_grids, read_headers

            if self._read == 0:
                if not self._entry.job.new_person:  # those of before; freed later, the new ones would be read twice
                    free_unused_grids()
                read_headers(path for path in written.files if path.is_file())
            self._read += read_grids(written.files[self._read :], SLICE_S)
        return self._read < len(written.files)

    def take(self, human: Path) -> WrittenHuman | None:
        """The person of this human.npz, whose files are the caller's from now on; None where they are not written."""
        return self._writing.take() if self._writing is not None and human == self._human else None

    def close(self) -> None:
        """Forget this person; what was written and not taken is removed."""
        if self._writing is not None:
            self._writing.stop()
        self._entry = self._human = self._writing = None
        self._read = self._shown = 0


def _place(job: Job) -> Destination | None:
    try:
        return job.place()
    except (ValueError, OSError):  # the operator tells what has become of the person
        return None


building = Building()
"""There is one line."""
